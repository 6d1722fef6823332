"""One HDF5 file per trial for everything but frames, in the event layout of the DSEC data set.

``events/{x,y,p,t}`` with ``ms_to_idx`` and ``t_offset`` opens in the tools that read DSEC; the
index reaches as far as their 32-bit times (71.6 min), later events are found by bisection. The
other streams are in the same file. Columns are chunked and compressed with bitshuffle, events in
LZ4 and the others in zstd; of a recording without a protocol in gzip, which every HDF5
library reads. Attributes give every column its unit. Files carry no time stamps: the same data are
the same bytes.

A trial has more columns than most of them have chunks, so that making, opening and resizing them
costs more than their data. So every file begins as a copy of one that has all columns and no rows,
and rows wait in memory until they are whole chunks.

Format 2 differs from 1 in the storage of events: LZ4 instead of zstd, and times after the offset in
32 bits (docs/decisions/data-files.md). A reader need not know which it has. Format 3 is format 2
with an index that ends before the last event.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import (
    EVENTS,
    EXPOSURES,
    FRAMES,
    I64,
    POSES,
    PULSES,
    READS,
    SCALAR,
    STREAM_NAME,
    TRIGGERS,
    WRENCH,
    Chunk,
    Column,
    EventChunk,
    FrameChunk,
    Json,
    StreamKind,
)

Array = npt.NDArray[Any]

FORMAT, INDEX_CUT_FORMAT = 2, 3
"""Formats of new files; the second one where the index ends before the events do."""
CACHE_BYTES = 1 << 20
"""Cache of each column. Chunks are written whole: HDF5's own 8 MiB would only hold memory."""
EVENT_CHUNK = 1 << 16
SMALL_CHUNK = 1 << 10
SMALL_HELD = 1 << 14
"""Rows of small columns that are buffered; the overhead of each write exceeds its data."""

GROUPS: dict[str, tuple[str, StreamKind]] = {
    "events": ("events", EVENTS),
    "event_pulses": ("events", PULSES.timed_by("ns of the event camera's clock")),
    "arm_pulses": ("arm", PULSES.timed_by("ns of the arm controller's clock")),
    "sync_pulses": (
        "sync_box",
        PULSES.timed_by("ns of the sync box's clock: the trial's time line"),
    ),
    "poses": ("arm", POSES),
    "frames": ("frames", FRAMES),
}
"""Streams of the rig's own devices: the device and the kind, by the group that holds them."""
LATE_GROUPS: dict[str, tuple[str, StreamKind]] = {
    "exposures": (
        "sync_box",
        EXPOSURES.timed_by("ns of the sync box's clock, start of an exposure"),
    ),
    "box_reads": ("sync_box", READS.timed_by("ns of the sync box's clock")),
    "frame_camera_reads": ("frames", READS.timed_by("ns of the frame camera's clock")),
    "triggers": ("events", TRIGGERS),
}
"""Those that are only there once something came, for they depend on which wires a rig has."""
OWN_DEVICES = {device for device, _ in GROUPS.values()}
TIMES = "events/t"
COLUMNS, TIMING = (
    {
        f"{group}/{part}": column
        for group, (_, kind) in groups.items()
        for part, column in kind.columns.items()
    }
    for groups in (GROUPS, LATE_GROUPS)
)
WIDE = COLUMNS[TIMES]
"""The times of events from the first one on that comes 2**32 us (71.6 min) after the offset."""
COLUMNS[TIMES] = WIDE._replace(dtype="uint32")
# only there once something came, a row a frame
TRACKS: dict[str, Column] = {
    "tracks/markers": Column(
        "markers_px", "float32", (-1, 2), "px, column and row; NaN where a marker was not seen"
    ),
    "tracks/plate": Column(
        "plate_px", "float32", (2,), "px, column and row; NaN where the marker was not seen"
    ),
}
STREAMS = {kind.name: kind for kind in (WRENCH, SCALAR)}
"""Kinds of SlipLab's own named streams, by name. A named stream is the group ``streams/NAME`` with
its kind as an attribute, only there once something came. Kinds of other packages are read by what
the group says."""
STREAM_GROUP, KIND_ATTRIBUTE, UNIT_ATTRIBUTE = "streams", "kind", "unit"
_GROUP_OF = {(device, kind.name): group for group, (device, kind) in (GROUPS | LATE_GROUPS).items()}
INDEX, OFFSET = "ms_to_idx", "t_offset"
_LAST_32 = 2**32 - 1
INDEXED_MS = 2**32 // 1000 + 1
"""Length of the index, ms: the range of DSEC's 32-bit times."""
# one block a chunk: in the filter's own blocks of 8 kB, half of the time goes into beginning them
_SMALL = hdf5plugin.Bitshuffle(nelems=EVENT_CHUNK, cname="zstd", clevel=1)
_EVENTS = hdf5plugin.Bitshuffle(nelems=EVENT_CHUNK, cname="lz4")
_PORTABLE = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
# whole bytes: the lowest one of a time is noise, the highest ones are all but constant
_TIMES = hdf5plugin.Blosc(cname="lz4", clevel=5, shuffle=hdf5plugin.Blosc.SHUFFLE)


@cache
def blank(guarded: bool = False) -> bytes:
    """Make a file with every column of `COLUMNS`, an index and an offset, and no rows."""
    made = BytesIO()
    with h5py.File(made, "w", libver="latest") as file:
        file.attrs["format"] = FORMAT
        for name, column in (COLUMNS | ({TIMES: WIDE} if guarded else {})).items():
            create(file, name, column, guarded)
        marks = Column("", "int64", (), "index of the first event at or after this ms")
        create(file, INDEX, marks, guarded)
        file[OFFSET] = np.int64(0)
        file[OFFSET].attrs["unit"] = "us of the event camera's clock"
    return made.getvalue()


def create(file: Any, name: str, column: Column, guarded: bool = False) -> None:
    """Make a dataset without rows in an open `h5py.File`.

    Args:
        guarded: for a recording without a protocol: use filters that every HDF5 library has.
    """
    data = file.create_dataset(
        name,
        (0, *column.shape),
        column.dtype,
        maxshape=(None, *column.shape),
        chunks=(_chunk(name), *column.shape),
        **(_PORTABLE if guarded else _filter(name)),
    )
    data.attrs["unit"] = column.unit


def _filter(name: str) -> Any:
    if name.startswith(TIMES):
        return _TIMES
    return _EVENTS if name.startswith("events/") else _SMALL


def _chunk(name: str) -> int:
    return EVENT_CHUNK if name.startswith("events/") else SMALL_CHUNK


class _Rows:
    """A dataset that grows at its end.

    Rows are gathered until they fill whole chunks: a partial one would be compressed twice.

    Attributes:
        shape: of one row.
        crc: CRC-32 of all rows so far; None where it is not computed.
    """

    crc: int | None = None

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
            # up to the end of a chunk, also where a mark has written a part of one
            room = len(self._held) - self.count % len(self._held)
            part = values[:room]
            held = self._held[self._waiting : self._waiting + len(part)]
            held[:] = part
            if self.crc is not None:
                self.crc = zlib.crc32(held.data, self.crc)
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

    def widened(self, file: Any, name: str, kind: Column) -> _Rows:
        """Return the same rows as another type, in place of the dataset `name`."""
        self.flush()
        wider = f"{name}64"
        create(file, wider, kind)
        column = _Rows(file, wider)
        old = file[name]
        for start in range(0, self._written, EVENT_CHUNK):
            column.append(old[start : start + EVENT_CHUNK])
        column.flush()
        del file[name]
        file.move(wider, name)
        return column


def cut(path: Path, state: Json) -> None:
    """Cut a guarded file to the rows of one of its marks, and finish it.

    Args:
        state: what `StreamFile.mark` returned.
    """
    rows = {name: count for name, (count, _) in state["columns"].items()}
    with h5py.File(path, "r+", libver="latest") as file:
        for name, count in rows.items():
            file[name].resize(count, axis=0)
        if rows[INDEX] < INDEXED_MS:  # as `StreamFile.finish`
            file[INDEX].resize(rows[INDEX] + 1, axis=0)
            file[INDEX][-1] = rows[TIMES]
        else:
            file.attrs["format"] = INDEX_CUT_FORMAT
        file[OFFSET][()] = state["offset_us"]


class StreamFile:
    """A trial's HDF5 file while it is written; append only.

    Args:
        expected: empty chunks of every stream that may come, by device. The file is then readable
            up to its last `mark` whenever the program is killed; nothing else can be added.
    """

    def __init__(self, path: Path, expected: Mapping[str, Iterable[Chunk]] | None = None) -> None:
        self.path = path
        self._guarded = self._wide = expected is not None
        path.write_bytes(blank(self._guarded))
        self._file = h5py.File(path, "r+", libver="latest", rdcc_nbytes=CACHE_BYTES)
        self._offset: int | None = None
        self._last_us: int | None = None
        self._next_ms = 0
        self._kinds: dict[str, StreamKind] = {}
        self._columns = {name: _Rows(self._file, name) for name in (*COLUMNS, INDEX)}
        if expected is not None:
            self._guard(expected)

    def _guard(self, expected: Mapping[str, Iterable[Chunk]]) -> None:
        """Make all columns, and let HDF5 write in an order in which the file is always readable.

        HDF5's cache of its indexes would grow to 32 MiB within a long recording.
        """
        for device, chunks in expected.items():
            for chunk in chunks:
                path = self._path(device, chunk.KIND)
                if f"{path}/t" not in self._columns:
                    self._make(path, chunk)
        for column in self._columns.values():
            column.crc = 0
        cache = self._file.id.get_mdc_config()
        cache.set_initial_size, cache.incr_mode, cache.flash_incr_mode = True, 0, 0
        cache.initial_size = cache.max_size = cache.min_size = CACHE_BYTES
        self._file.id.set_mdc_config(cache)
        self._file.swmr_mode = True

    def mark(self) -> Json:
        """Write all rows; return how many each column has, and their CRC-32."""
        for column in self._columns.values():
            column.flush()
        self._file.flush()
        columns = {name: [column.count, column.crc] for name, column in self._columns.items()}
        return {"offset_us": self._offset or 0, "columns": columns}

    @property
    def counts(self) -> dict[str, int]:
        """Rows so far, by column."""
        return {name: column.count for name, column in self._columns.items() if name != INDEX}

    def add(self, device: str, chunk: Chunk) -> None:
        """Append rows to the stream of a device, which is made when its first row comes.

        Events come in time order. Of frames only their numbers and times are written.

        Raises:
            ValueError: the name is not a small identifier, the stream is of another kind, or times
                of events decrease.
        """
        kind = chunk.KIND
        path = self._path(device, kind)
        if not len(chunk):
            return
        if isinstance(chunk, EventChunk):
            chunk = self._indexed(chunk)
        if f"{path}/t" not in self._columns:
            self._make(path, chunk)
        for part, column in kind.columns.items():
            self._columns[f"{path}/{part}"].append(getattr(chunk, column.field))

    def _path(self, device: str, kind: StreamKind) -> str:
        """Return the group of a device's stream. Raises ValueError as `add`."""
        path = _GROUP_OF.get((device, kind.name))
        if path is None:
            path = f"{STREAM_GROUP}/{device}"
            if not STREAM_NAME.fullmatch(device):
                raise ValueError(f"stream '{device}': a name must match {STREAM_NAME.pattern}")
            if (known := self._kinds.setdefault(device, kind).name) != kind.name:
                raise ValueError(f"stream '{device}': is of kind '{known}', not '{kind.name}'")
        return path

    def _make(self, path: str, chunk: Chunk) -> None:
        """Make the columns of a stream."""
        for part, column in chunk.KIND.columns.items():
            self._create(f"{path}/{part}", TIMING.get(f"{path}/{part}", column))
        if path.startswith(STREAM_GROUP):
            about = self._file[path].attrs
            about[KIND_ATTRIBUTE] = np.bytes_(chunk.KIND.name)
            units = {UNIT_ATTRIBUTE: getattr(chunk, "unit", "")}
            if chunk.KIND.name not in STREAMS:
                columns = chunk.KIND.columns.items()
                units |= {f"{UNIT_ATTRIBUTE}_{part}": column.unit for part, column in columns}
            about.update({key: np.bytes_(unit.encode()) for key, unit in units.items() if unit})

    def _indexed(self, chunk: EventChunk) -> EventChunk:
        """Return events with times after the offset, once they are in the index.

        Raises:
            ValueError: times decrease, inside the chunk or against the one before.
        """
        first, last = int(chunk.t_us[0]), int(chunk.t_us[-1])
        backwards = bool(np.any(chunk.t_us[1:] < chunk.t_us[:-1]))
        if backwards or (self._last_us is not None and first < self._last_us):
            raise ValueError(f"event times run backwards at {first} us")
        if self._offset is None:
            self._offset = first
        self._last_us = last
        times = chunk.t_us - self._offset
        self._mark(times, int(times[-1]) // 1000 + 1)
        if int(times[-1]) > _LAST_32 and not self._wide:
            self._columns[TIMES] = self._columns[TIMES].widened(self._file, TIMES, WIDE)
            self._wide = True
        return replace(chunk, t_us=times)

    def _mark(self, times: I64, end_ms: int) -> None:
        """Note the first event at or after each millisecond before `end_ms`.

        Block by block and up to `INDEXED_MS`: a gap may be of any length.
        """
        before = self._columns[TIMES].count
        for low in range(self._next_ms, min(end_ms, INDEXED_MS), SMALL_HELD):
            high = min(low + SMALL_HELD, end_ms, INDEXED_MS)
            marks = np.arange(low, high, dtype=np.int64) * 1000
            self._columns[INDEX].append(before + np.searchsorted(times, marks, side="left"))
        self._next_ms = max(end_ms, self._next_ms)

    def add_tracks(self, chunk: FrameChunk) -> None:
        """Append the marker positions that a camera returns instead of its frames.

        The frames' times come first. Every column of tracks gets a row a frame: NaN where a plate's
        marker came later than the first frame, or went.
        """
        after = self._columns["frames/t"].count
        before = after - len(chunk)
        found = {"tracks/markers": chunk.markers_px, "tracks/plate": chunk.plate_px}
        for name, values in found.items():
            if values is None and name not in self._columns:
                continue
            if values is not None and name not in self._columns:
                self._create(name, TRACKS[name]._replace(shape=values.shape[1:]))
            column = self._columns[name]
            missing = (before if values is not None else after) - column.count
            if missing:
                column.append(np.full((missing, *column.shape), np.nan, np.float32))
            if values is not None:
                column.append(values)

    def _create(self, name: str, column: Column) -> None:
        create(self._file, name, column, self._guarded)
        self._columns[name] = _Rows(self._file, name)

    def finish(self) -> None:
        """Write buffered rows and the index, and close the file in any case."""
        try:
            if self._next_ms > INDEXED_MS:
                self._file.attrs["format"] = INDEX_CUT_FORMAT
            else:  # one more mark, so that the last millisecond has an end
                self._columns[INDEX].append(np.full(1, self._columns[TIMES].count, np.int64))
            for column in self._columns.values():
                column.flush()
            self._file[OFFSET][()] = self._offset or 0
            self._file.flush()
        except BaseException:
            self.abandon()
            raise
        self._file.close()

    def abandon(self) -> None:
        """Close the file as far as its disk takes it.

        HDF5 ends the program with a segmentation fault, at once or at its exit, if it cannot write
        while it closes a file. What the disk does not take goes to /dev/null instead.
        """
        if not self._file:
            return
        try:
            self._file.flush()
        except (OSError, RuntimeError):
            nothing = os.open(os.devnull, os.O_RDWR | os.O_CLOEXEC)
            try:
                os.dup2(nothing, self._file.id.get_vfd_handle(), inheritable=False)
            finally:
                os.close(nothing)
        self._file.close()
