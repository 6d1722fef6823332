"""Flatbuffers as dv-processing writes them: on the wire of a camera, and in AEDAT4 files.

Each buffer has its length in front: `EVTS` is a vector of 16-byte structs, `TRIG` a vector of
tables, `FRME` a table with pixels, `IOHE` a header with a description. Layouts were read off what
dv-processing 2.0.4 writes (tests compare them with it); all numbers little-endian.

A flatbuffer consists of offsets into itself. A table begins with the offset back to its vtable, the
list of its fields' positions; a field that is not in the list has its default value. The reader
checks every offset against the buffer's size.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.streams import I64, U8, EventChunk

EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "p"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
"""One event: time in us, column, row, whether it became brighter."""
GREY = 0
"""OpenCV's number of an 8-bit picture with one channel."""
_VECTOR = bytes.fromhex("0000 0600 0800 0400 06000000 04000000")
"""A table with one field, a vector, whose length follows: padding, vtable, table."""
_TRIGGER_VTABLE = struct.pack("<4H", 8, 16, 8, 7)
"""Vtable of a trigger's table of 16 bytes: time at 8, kind at 7."""
_FRAME_VTABLE = struct.pack("<13H", 26, 60, 4, 12, 20, 28, 36, 44, 46, 48, 50, 52, 56)
"""Five times, kind, width, height, place, and where the pixels are."""


class FlatTable:
    """A table at a place in some bytes."""

    def __init__(self, data: memoryview, at: int) -> None:
        self._data, self._at = data, at
        self._fields = at - _number(data, "<i", at)
        self._count = (_number(data, "<H", self._fields) - 4) // 2

    @classmethod
    def root(cls, data: memoryview, identifier: bytes) -> FlatTable:
        """Return the table of a buffer with its length in front and an identifier.

        Raises:
            FormatError: it is another, or none.
        """
        if bytes(data[8:12]) != identifier:
            raise FormatError(f"holds {bytes(data[8:12])!r} where {identifier!r} belongs")
        return cls(data, 4 + _number(data, "<I", 4))

    def number(self, field: int, form: str, default: int = 0) -> int:
        """Return an integer of the type `form`, as `struct` names it."""
        at = self._place(field)
        return default if at is None else _number(self._data, form, at)

    def vector(self, field: int, size: int) -> tuple[int, memoryview]:
        """Return length and content of a vector of items of `size` bytes."""
        at = self._place(field)
        if at is None:
            return 0, self._data[:0]
        at += _number(self._data, "<I", at)
        count = _number(self._data, "<I", at)
        if count * size > len(self._data) - at - 4:
            raise FormatError(f"is damaged: {count} items in too few bytes")
        return count, self._data[at + 4 : at + 4 + count * size]

    def tables(self, field: int) -> list[FlatTable]:
        """Return a vector of tables."""
        at = self._place(field)
        if at is None:
            return []
        first = at + _number(self._data, "<I", at) + 4
        count, _ = self.vector(field, 4)
        places = range(first, first + 4 * count, 4)
        return [FlatTable(self._data, place + _number(self._data, "<I", place)) for place in places]

    def _place(self, field: int) -> int | None:
        if field >= self._count:
            return None
        offset = _number(self._data, "<H", self._fields + 4 + 2 * field)
        return self._at + offset if offset else None


def _number(data: memoryview, form: str, at: int) -> int:
    if not 0 <= at <= len(data) - struct.calcsize(form):
        raise FormatError("is damaged: an offset points outside its packet")
    found: Any = struct.unpack_from(form, data, at)[0]
    return int(found)


def events_buffer(chunk: EventChunk) -> bytes:
    """Encode events in order of time."""
    rows = np.zeros(len(chunk), EVENT)
    rows["t"], rows["x"], rows["y"], rows["p"] = chunk.t_us, chunk.x, chunk.y, chunk.p
    return _whole(b"EVTS", struct.pack("<I", len(chunk)) + rows.tobytes())


def triggers_buffer(t_us: I64, kind: int | U8) -> bytes:
    """Encode triggers at these times, us, of one kind or of a kind each."""
    n = len(t_us)
    # counted from the length in front of the flatbuffer: count at 28, then an offset for each
    tables = (32 + 4 * n + 8 + 7) // 8 * 8
    places = tables + 16 * np.arange(n, dtype=np.int64)
    offsets: npt.NDArray[np.uint32] = (places - (32 + 4 * np.arange(n))).astype("<u4")
    rows = np.zeros(
        n,
        np.dtype(
            {
                "names": ["vtable", "kind", "t"],
                "formats": ["<i4", "u1", "<i8"],
                "offsets": [0, 7, 8],
                "itemsize": 16,
            }
        ),
    )
    rows["vtable"], rows["kind"], rows["t"] = places - (tables - 8), kind, t_us
    padding = bytes(tables - 8 - (32 + 4 * n))
    vector = struct.pack("<I", n) + offsets.tobytes()
    return _whole(b"TRIG", vector + padding + _TRIGGER_VTABLE + rows.tobytes())


def frame_buffer(image: U8, t_us: int) -> bytes:
    """Encode a frame of grey levels (height, width), timed at the middle of exposure, us."""
    height, width = image.shape
    # counted from the length in front: the list of fields at 12, its table at 44, pixels at 108
    table = struct.pack("<i5qbx4h2xI", 44 - 14, *(5 * [t_us]), GREY, width, height, 0, 0, 4)
    body = struct.pack("<I", 40) + b"FRME" + bytes(2) + _FRAME_VTABLE + bytes(4) + table
    return _with_length(body + struct.pack("<I", image.size) + image.tobytes())


def header_buffer(text: str, compression: int) -> bytes:
    """Encode a header: compression (0: none, 3: zstd), no index, and description."""
    data = text.encode()
    table = struct.pack("<iiIq", 10, compression, 12, -1)
    body = struct.pack("<I", 24) + b"IOHE" + bytes(6) + struct.pack("<5H", 10, 20, 4, 12, 8) + table
    return _with_length(body + struct.pack("<I", len(data)) + data + b"\0")


def _whole(kind: bytes, vector: bytes) -> bytes:
    return _with_length(struct.pack("<I", 16) + kind + _VECTOR + vector)


def _with_length(body: bytes) -> bytes:
    body += bytes(-len(body) % 4)
    return struct.pack("<I", len(body)) + body
