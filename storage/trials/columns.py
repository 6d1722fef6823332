"""The columns of a trial's HDF5 file, and how each of them grows.

A trial has more columns than it has chunks in most of them, so that making, opening and resizing
them costs more than their data. So every file begins as a copy of one that has all columns and no
rows, and rows wait in memory until they are whole chunks.

Format 2 differs from 1 in how events are kept: LZ4 instead of zstd, and times after the offset in
32 bits (docs/decisions/0020). A reader need not know which it has. Format 3 is format 2 with an
index that ends before the last event (docs/decisions/0067).
"""

from __future__ import annotations

from functools import cache
from io import BytesIO
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]
Kind = tuple[str, tuple[int, ...], str]
"""Type, shape of a row, unit."""

FORMAT, INDEX_CUT_FORMAT = 2, 3
"""What a file is written as; the second one where its index ends before its events do."""
EVENT_CHUNK = 1 << 16
SMALL_CHUNK = 1 << 10
SMALL_HELD = 1 << 14
"""Rows of small columns that are held back; each write costs more than what is in it."""

COLUMNS: dict[str, Kind] = {
    "events/x": ("uint16", (), "px"),
    "events/y": ("uint16", (), "px"),
    "events/p": ("uint8", (), "1 brighter, 0 darker"),
    "events/t": ("uint32", (), "us of the event camera's clock after t_offset"),
    "event_pulses/t": ("int64", (), "ns of the event camera's clock"),
    "arm_pulses/t": ("int64", (), "ns of the arm controller's clock"),
    "sync_pulses/t": ("int64", (), "ns of the sync box's clock: the trial's time line"),
    "poses/t": ("int64", (), "ns of the arm controller's clock"),
    "poses/host": ("int64", (), "ns of the host's monotonic clock"),
    "poses/xyz": ("float64", (3,), "mm in the arm's base frame"),
    "poses/rotvec": ("float64", (3,), "degrees, rotation vector"),
    "frames/number": ("int64", (), "the camera's frame counter"),
    "frames/t": ("int64", (), "ns of the frame camera's clock, middle of exposure"),
    "frames/host": ("int64", (), "ns of the host's monotonic clock"),
    "frames/sync": ("uint8", (), "level of the sync line during exposure"),
}
# only there once something came, a row a frame; -1 stands for the number of markers
TRACKS: dict[str, Kind] = {
    "tracks/markers": ("float32", (-1, 2), "px, column and row; NaN where a marker was not seen"),
    "tracks/plate": ("float32", (2,), "px, column and row; NaN where the marker was not seen"),
}
# only there once something came, for they depend on which wires a rig has
TIMING: dict[str, Kind] = {
    "exposures/t": ("int64", (), "ns of the sync box's clock, start of an exposure"),
    "box_reads/t": ("int64", (), "ns of the sync box's clock"),
    "box_reads/before": ("int64", (), "ns of the host's monotonic clock"),
    "box_reads/after": ("int64", (), "ns of the host's monotonic clock"),
    "frame_camera_reads/t": ("int64", (), "ns of the frame camera's clock"),
    "frame_camera_reads/before": ("int64", (), "ns of the host's monotonic clock"),
    "frame_camera_reads/after": ("int64", (), "ns of the host's monotonic clock"),
    "triggers/t": ("int64", (), "ns of the event camera's clock"),
    "triggers/kind": ("uint8", (), "what the event camera noted, as AEDAT4 numbers it"),
}
TIMES = "events/t"
WIDE: Kind = ("int64", (), COLUMNS[TIMES][2])
"""The times of events from the first one on that comes 2**32 us (71.6 min) after the offset."""
INDEX, OFFSET = "ms_to_idx", "t_offset"
INDEXED_MS = 2**32 // 1000 + 1
"""Milliseconds that the index reaches to: those that DSEC's 32-bit times can tell."""
# one block a chunk: in the filter's own blocks of 8 kB, half of the time goes into beginning them
_SMALL = hdf5plugin.Bitshuffle(nelems=EVENT_CHUNK, cname="zstd", clevel=1)
_EVENTS = hdf5plugin.Bitshuffle(nelems=EVENT_CHUNK, cname="lz4")
# whole bytes: the lowest one of a time is noise, the highest ones are all but constant
_TIMES = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)


@cache
def blank() -> bytes:
    """A file with every column of `COLUMNS`, an index and an offset, and no rows."""
    made = BytesIO()
    with h5py.File(made, "w", libver="latest") as file:
        file.attrs["format"] = FORMAT
        for name, kind in COLUMNS.items():
            create(file, name, kind)
        create(file, INDEX, ("int64", (), "index of the first event at or after this ms"))
        file[OFFSET] = np.int64(0)
        file[OFFSET].attrs["unit"] = "us of the event camera's clock"
    return made.getvalue()


def create(file: Any, name: str, kind: Kind) -> None:
    """A dataset without rows in an open `h5py.File`."""
    dtype, shape, unit = kind
    data = file.create_dataset(
        name,
        (0, *shape),
        dtype,
        maxshape=(None, *shape),
        chunks=(_chunk(name), *shape),
        **_filter(name),
    )
    data.attrs["unit"] = unit


def _filter(name: str) -> Any:
    if name.startswith(TIMES):
        return _TIMES
    return _EVENTS if name.startswith("events/") else _SMALL


def _chunk(name: str) -> int:
    return EVENT_CHUNK if name.startswith("events/") else SMALL_CHUNK


class Column:
    """A dataset that grows at its end.

    Rows are gathered until they fill whole chunks: a partial one would be compressed twice.

    Attributes:
        shape: of one row.
    """

    def __init__(self, file: Any, name: str) -> None:
        self._data = h5py.h5d.open(file.id, name.encode())
        self.shape: tuple[int, ...] = self._data.shape[1:]
        rows = EVENT_CHUNK if _chunk(name) == EVENT_CHUNK else SMALL_HELD
        self._held: Array = np.empty((rows, *self.shape), self._data.dtype)
        self._written = self._waiting = 0

    @property
    def count(self) -> int:
        """Rows appended so far, written or not."""
        return self._written + self._waiting

    def append(self, values: Array) -> None:
        """Add rows, (k, *shape)."""
        while len(values):
            room = len(self._held) - self._waiting
            part = values[:room]
            self._held[self._waiting : self._waiting + len(part)] = part
            self._waiting += len(part)
            if len(part) == room:
                self.flush()
            values = values[room:]

    def flush(self) -> None:
        """Write what waits."""
        if not self._waiting:
            return
        rows = self._held[: self._waiting]
        end = self._written + len(rows)
        self._data.set_extent((end, *self.shape))
        place = self._data.get_space()
        place.select_hyperslab((self._written, *(0 for _ in self.shape)), rows.shape)
        self._data.write(h5py.h5s.create_simple(rows.shape), place, rows)
        self._written, self._waiting = end, 0

    def widened(self, file: Any, name: str, kind: Kind) -> Column:
        """The same rows as another type, in place of the dataset `name`."""
        self.flush()
        wider = f"{name}64"
        create(file, wider, kind)
        column = Column(file, wider)
        old = file[name]
        for start in range(0, self._written, EVENT_CHUNK):
            column.append(old[start : start + EVENT_CHUNK])
        column.flush()
        del file[name]
        file.move(wider, name)
        return column
