"""The error of invalid input.

Every input file of the project (protocols, rig files) and every bad option ends in an
`InputError`: it names the file, the key, the value, and what would be right. The command line
prints it as one message and exits with 2.
"""

from __future__ import annotations

from pathlib import Path

from sliplab.protocols.shown import MASK, printable, shown, shown_key


class InputError(ValueError):
    """Invalid input, described so that the user can correct it without reading any code.

    Attributes:
        file: the file the input came from, or a command-line option's name.
        key: the path of the key inside it, such as ``collection.factors.depth.values[2]``.
        value: what was found there, as text, secrets masked; ``None`` where nothing was found.
        expected: what would be right, as a phrase.
    """

    def __init__(self, file: str | Path, key: str, value: object | None, expected: str) -> None:
        self.file = str(file)
        self.key = shown_key(key)
        self.value = None if value is None else shown(value, key)
        self.expected = expected
        if self.value == MASK:
            self.expected = expected.replace(str(value), MASK)
        super().__init__(self.message)

    def __reduce__(self) -> tuple[type[InputError], tuple[str | None, ...]]:
        """Its own arguments: it may come from another process."""
        return type(self), (self.file, self.key, self.value, self.expected)

    @property
    def message(self) -> str:
        """``file: key = value: expected`` in one line."""
        where = f"{self.file}: {self.key}" if self.key else self.file
        found = "" if self.value is None else f" = {self.value}"
        return printable(f"{where}{found}: {self.expected}").replace("\n", "\\n")

    def in_file(self, file: str | Path) -> InputError:
        """The same error, for input that turned out to come from `file`."""
        return InputError(file, self.key, self.value, self.expected)
