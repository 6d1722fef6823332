"""Just enough of flatbuffers to read AEDAT4, every place checked against the bytes.

A flatbuffer is full of distances to other places in it. A table begins with the distance back to a
list of where its fields are; a field that is not in the list has its default value.
"""

from __future__ import annotations

import struct
from typing import Any

from sliplab.storage.formats.foreign import FormatError


class Table:
    """A table at a place in some bytes."""

    def __init__(self, data: memoryview, at: int) -> None:
        self._data, self._at = data, at
        self._fields = at - _number(data, "<i", at)
        self._count = (_number(data, "<H", self._fields) - 4) // 2

    @classmethod
    def root(cls, data: memoryview, identifier: bytes) -> Table:
        """The table of a buffer with its length in front and an identifier.

        Raises:
            FormatError: it is another, or none.
        """
        if bytes(data[8:12]) != identifier:
            raise FormatError(f"holds {bytes(data[8:12])!r} where {identifier!r} belongs")
        return cls(data, 4 + _number(data, "<I", 4))

    def number(self, field: int, form: str, default: int = 0) -> int:
        """An integer of the type `form`, as `struct` names it."""
        at = self._place(field)
        return default if at is None else _number(self._data, form, at)

    def vector(self, field: int, size: int) -> tuple[int, memoryview]:
        """Length and content of a vector of things of so many bytes."""
        at = self._place(field)
        if at is None:
            return 0, self._data[:0]
        at += _number(self._data, "<I", at)
        count = _number(self._data, "<I", at)
        if count * size > len(self._data) - at - 4:
            raise FormatError(f"is damaged: {count} things in too few bytes")
        return count, self._data[at + 4 : at + 4 + count * size]

    def tables(self, field: int) -> list[Table]:
        """A vector of tables."""
        at = self._place(field)
        if at is None:
            return []
        first = at + _number(self._data, "<I", at) + 4
        count, _ = self.vector(field, 4)
        places = range(first, first + 4 * count, 4)
        return [Table(self._data, place + _number(self._data, "<I", place)) for place in places]

    def _place(self, field: int) -> int | None:
        if field >= self._count:
            return None
        offset = _number(self._data, "<H", self._fields + 4 + 2 * field)
        return self._at + offset if offset else None


def _number(data: memoryview, form: str, at: int) -> int:
    if not 0 <= at <= len(data) - struct.calcsize(form):
        raise FormatError("is damaged: a packet leads out of its own bytes")
    found: Any = struct.unpack_from(form, data, at)[0]
    return int(found)
