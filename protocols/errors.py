"""The error of invalid input.

Every input file of the project (protocols, rig files) and every bad option ends in an
`InputError`: it names the file, the key, the value, and what would be right. The command line
prints it as one message and exits with 2.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from sliplab.protocols.shown import MASK, printable, shown, shown_key

MOST_LINES = 20
"""Faults that a message lists; the rest is counted."""


class InputError(ValueError):
    """Invalid input, described so that the user can correct it without reading any code.

    Attributes:
        file: the file the input came from, or a command-line option's name.
        key: the path of the key inside it, such as ``collection.factors.depth.values[2]``.
        value: what was found there, as text, secrets masked; ``None`` where nothing was found.
        expected: what would be right, as a phrase.
        more: further faults that were found together with this one, usually in the same file.
    """

    def __init__(
        self,
        file: str | Path,
        key: str,
        value: object | None,
        expected: str,
        more: Iterable[InputError] = (),
    ) -> None:
        self.file = str(file)
        self.key = shown_key(key)
        self.value = None if value is None else shown(value, key)
        self.expected = expected
        if self.value == MASK:
            self.expected = expected.replace(str(value), MASK)
        self.more = tuple(more)
        super().__init__(self.message)

    @classmethod
    def joined(cls, faults: Iterable[InputError]) -> InputError:
        """Return the first of some errors, with all others as its further faults."""
        first, *others = (each for fault in faults for each in fault.faults)
        return first.replaced(more=others) if others else first

    @property
    def faults(self) -> tuple[InputError, ...]:
        """This fault without the others, then each of the others."""
        return (self.replaced(more=()), *self.more) if self.more else (self,)

    def replaced(self, **changed: Any) -> InputError:
        """Return the same error with some of its attributes changed."""
        names = ("file", "key", "value", "expected", "more")
        made = type(self).__new__(type(self))  # a subclass may have other arguments
        InputError.__init__(made, **{name: getattr(self, name) for name in names} | changed)
        return made

    def __reduce__(self) -> tuple[type[InputError], tuple[Any, ...]]:
        """Its own arguments: it may come from another process."""
        return type(self), (self.file, self.key, self.value, self.expected, self.more)

    @property
    def message(self) -> str:
        """``file: key = value: expected``, one line a fault; at most 20 of them."""
        where = f"{self.file}: {self.key}" if self.key else self.file
        found = "" if self.value is None else f" = {self.value}"
        line = printable(f"{where}{found}: {self.expected}")
        line = line.replace("\n", "\\n").replace("\t", " ")
        lines = [line, *(each.message for each in self.more[: MOST_LINES - 1])]
        if len(self.more) >= MOST_LINES:
            lines.append(f"and {len(self.more) - MOST_LINES + 1} more")
        return "\n".join(lines)
