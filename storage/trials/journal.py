"""Journals of requests and decisions: numbered JSON files that are never changed.

The first writer of a file owns its number, so two people never overwrite each
other. No lock is needed.
"""

from __future__ import annotations

import re
import socket
from dataclasses import dataclass
from pathlib import Path

from sliplab.storage.files import make_folder, write_new_json
from sliplab.storage.process import now, user_name
from sliplab.storage.streams import Json

_FILE = re.compile(r"(\d{6,12})\.json")
_MOST_TRIES = 1000


@dataclass(frozen=True, kw_only=True)
class Entry:
    """One entry of a person.

    Attributes:
        number: its place in the journal, from 1.
        when: UTC, ISO 8601.
        host: name of the machine that it was made on.
    """

    number: int
    who: str
    when: str
    why: str = ""
    host: str = ""

    def _summary(self, what: str) -> str:
        why = f" ({self.why})" if self.why else ""
        return f"{what} by {self.who}, {self.when}{why}"


def signature(who: str, why: str) -> dict[str, str]:
    """Return ``who``, ``when``, ``why`` and ``host`` of an entry that is made here and now.

    Args:
        who: empty for the user that is logged in.
    """
    return {"who": who or user_name(), "when": now(), "why": why, "host": socket.gethostname()}


@dataclass(frozen=True)
class Journal:
    """The numbered files of one folder, which need not exist yet."""

    folder: Path

    def path(self, number: int, mark: str = "") -> Path:
        """Return the path of an entry; with a mark, of a file that belongs to it."""
        return self.folder / f"{number:06d}{mark}.json"

    def numbers(self) -> list[int]:
        """Return the numbers of all entries, rising."""
        if not self.folder.is_dir():
            return []
        found = (_FILE.fullmatch(path.name) for path in self.folder.iterdir())
        return sorted(int(match[1]) for match in found if match)

    def append(self, data: Json) -> int:
        """Write the next entry, and return its number; two writers at once get two numbers.

        Raises:
            OSError: it cannot be written.
        """
        number = max(self.numbers(), default=0)
        for _ in range(_MOST_TRIES):
            number += 1
            if self.add(number, data):
                return number
        raise OSError(f"{self.folder}: no free number")

    def add(self, number: int, data: Json) -> bool:
        """Write an entry, complete and flushed; False if its number is taken.

        Raises:
            OSError: it cannot be written.
        """
        make_folder(self.folder)
        return write_new_json(self.path(number), data)
