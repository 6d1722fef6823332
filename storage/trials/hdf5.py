"""One HDF5 file a trial for everything but frames, in the event layout of the DSEC data set.

``events/{x,y,p,t}`` with ``ms_to_idx`` and ``t_offset`` opens in the tools that read DSEC; the
index reaches as far as their 32-bit times (71.6 min), later events are found by bisection. The
other streams stand beside them. Columns are chunked and compressed with bitshuffle, events in
LZ4 and the others in zstd. Attributes give every column its unit. Files carry no time stamps: the
same data are the same bytes.
"""

from __future__ import annotations

import os
from bisect import bisect_left
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np

from sliplab.storage.errors import StoreError
from sliplab.storage.streams import (
    I64,
    U8,
    ClockReads,
    EventChunk,
    FrameChunk,
    PoseChunk,
    PulseChunk,
)
from sliplab.storage.trials.columns import (
    COLUMNS,
    INDEX,
    INDEX_CUT_FORMAT,
    INDEXED_MS,
    OFFSET,
    SMALL_HELD,
    TIMES,
    TIMING,
    TRACKS,
    WIDE,
    Array,
    Column,
    blank,
    create,
)
from sliplab.storage.trials.rows import RowFile, Rows

_LAST_32 = 2**32 - 1
_READS = ("t", "before", "after")


class StreamFile:
    """A trial's HDF5 file while it is written; append only."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.write_bytes(blank())
        self._file = h5py.File(path, "r+", libver="latest")
        self._offset: int | None = None
        self._last_us: int | None = None
        self._next_ms = 0
        self._wide = False
        self._columns = {name: Column(self._file, name) for name in (*COLUMNS, INDEX)}

    @property
    def counts(self) -> dict[str, int]:
        """Rows so far, by column."""
        return {name: column.count for name, column in self._columns.items() if name != INDEX}

    def _append(self, name: str, values: Array) -> None:
        self._columns[name].append(values)

    def add_events(self, chunk: EventChunk) -> None:
        """Append events.

        Raises:
            ValueError: times run backwards, inside the chunk or against the one before.
        """
        if not len(chunk):
            return
        first, last = int(chunk.t_us[0]), int(chunk.t_us[-1])
        backwards = bool(np.any(chunk.t_us[1:] < chunk.t_us[:-1]))
        if backwards or (self._last_us is not None and first < self._last_us):
            raise ValueError(f"event times run backwards at {first} us")
        if self._offset is None:
            self._offset = first
        self._last_us = last
        times = chunk.t_us - self._offset
        self._mark(times, int(times[-1]) // 1000 + 1)
        self._append("events/x", chunk.x)
        self._append("events/y", chunk.y)
        self._append("events/p", chunk.p)
        if int(times[-1]) > _LAST_32 and not self._wide:
            self._columns[TIMES] = self._columns[TIMES].widened(self._file, TIMES, WIDE)
            self._wide = True
        self._append(TIMES, times)

    def _mark(self, times: I64, end_ms: int) -> None:
        """Note the first event at or after each millisecond before `end_ms`.

        Block by block and up to `INDEXED_MS`: a gap may be of any length.
        """
        before = self._columns[TIMES].count
        for low in range(self._next_ms, min(end_ms, INDEXED_MS), SMALL_HELD):
            high = min(low + SMALL_HELD, end_ms, INDEXED_MS)
            marks = np.arange(low, high, dtype=np.int64) * 1000
            self._append(INDEX, before + np.searchsorted(times, marks, side="left"))
        self._next_ms = max(end_ms, self._next_ms)

    def add_pulses(self, group: str, chunk: PulseChunk) -> None:
        """Append pulses to ``event_pulses``, ``arm_pulses`` or ``sync_pulses``."""
        self._append(f"{group}/t", chunk.t_ns)

    def add_exposures(self, chunk: PulseChunk) -> None:
        """Append starts of exposures to ``exposures``."""
        self._append_late({"exposures/t": chunk.t_ns})

    def add_clock_reads(self, group: str, chunk: ClockReads) -> None:
        """Append reads of a clock to ``box_reads`` or ``frame_camera_reads``."""
        columns = zip(_READS, (chunk.device_ns, chunk.before_ns, chunk.after_ns), strict=True)
        self._append_late({f"{group}/{name}": values for name, values in columns})

    def add_triggers(self, t_ns: I64, kind: U8) -> None:
        """Append what else an event camera noted, of an imported trial."""
        self._append_late({"triggers/t": t_ns, "triggers/kind": kind})

    def _append_late(self, columns: dict[str, Array]) -> None:
        """Append to columns of `TIMING`, which are made when the first row comes."""
        for name, values in columns.items():
            if not len(values):
                continue
            if name not in self._columns:
                create(self._file, name, TIMING[name])
                self._columns[name] = Column(self._file, name)
            self._append(name, values)

    def add_poses(self, chunk: PoseChunk) -> None:
        """Append arm poses."""
        self._append("poses/t", chunk.t_ns)
        self._append("poses/host", chunk.host_ns)
        self._append("poses/xyz", chunk.xyz_mm)
        self._append("poses/rotvec", chunk.rotvec_deg)

    def add_frame_times(self, chunk: FrameChunk) -> None:
        """Append what is known of frames besides their pixels."""
        self._append("frames/number", chunk.number)
        self._append("frames/t", chunk.t_ns)
        self._append("frames/host", chunk.host_ns)
        self._append("frames/sync", chunk.sync)

    def add_tracks(self, chunk: FrameChunk) -> None:
        """Append the places that a camera found in its frames instead of handing them over.

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
                dtype, _, unit = TRACKS[name]
                create(self._file, name, (dtype, values.shape[1:], unit))
                self._columns[name] = Column(self._file, name)
            column = self._columns[name]
            missing = (before if values is not None else after) - column.count
            if missing:
                column.append(np.full((missing, *column.shape), np.nan, np.float32))
            if values is not None:
                column.append(values)

    def finish(self) -> None:
        """Write what is held back and the index, and close the file, whatever happens."""
        try:
            if self._next_ms > INDEXED_MS:
                self._file.attrs["format"] = INDEX_CUT_FORMAT
            else:  # one more mark, so that the last millisecond has an end
                self._append(INDEX, np.full(1, self._columns[TIMES].count, np.int64))
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


class StreamReader:
    """A trial's HDF5 file opened for reading; a context manager.

    Raises:
        StoreError: it was written by a newer version.
        ValueError: a column points out of the file.
    """

    def __init__(self, path: Path) -> None:
        self._file = RowFile(path)
        try:
            found = self._file.attribute("format", 1)
            if found > INDEX_CUT_FORMAT:
                raise StoreError(
                    f"{path}: format = {found}: was written by a newer version of SlipLab; this "
                    f"one reads formats up to {INDEX_CUT_FORMAT}: update it"
                )
            self._index_cut = found == INDEX_CUT_FORMAT
            self.t_offset_us = int(self._file.rows(OFFSET).read())
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> StreamReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._file.close()

    def event_times(self) -> I64:
        """Times of all events on the camera's clock, us."""
        return self._times(0, len(self._file.rows(TIMES)))

    def _times(self, low: int, high: int) -> I64:
        """Times of some events on the camera's clock, us."""
        return self._file.rows(TIMES).added(low, high, self.t_offset_us)

    def events(self, start_us: int | None = None, end_us: int | None = None) -> EventChunk:
        """Events with start <= t < end on the camera's clock; all by default.

        Only the part of the file that holds them is read.
        """
        x, y, p = (self._file.rows(f"events/{name}") for name in "xyp")
        low, high = 0, len(self._file.rows(TIMES))
        marks = self._file.rows(INDEX)
        if start_us is not None and len(marks):
            low = self._bracket(marks, start_us - self.t_offset_us, high)[0]
        if end_us is not None and len(marks):
            high = self._bracket(marks, end_us - self.t_offset_us, high)[1]
        high = max(low, high)
        times = self._times(low, high)
        first = 0 if start_us is None else int(np.searchsorted(times, start_us, "left"))
        last = len(times) if end_us is None else int(np.searchsorted(times, end_us, "left"))
        last = max(first, last)
        low, high = low + first, low + last
        return EventChunk(
            x.read(low, high), y.read(low, high), p.read(low, high), times[first:last]
        )

    def _bracket(self, marks: Rows, t_us: int, count: int) -> tuple[int, int]:
        """Indices that enclose time `t_us` after the offset, from the index or behind its end."""
        ms = t_us // 1000
        near = marks.read(max(0, ms), max(0, ms + 2)).tolist()  # shorter at the end
        if ms < 0:
            return 0, near[0] if ms == -1 and near else 0
        if self._index_cut and len(near) < 2:
            times = self._file.rows(TIMES)
            rows = range(near[0] if near else 0, count)
            found = bisect_left(rows, t_us, key=lambda row: int(times.read(row, row + 1)[0]))
            return rows.start + found, rows.start + found
        near += [count, count]
        return near[0], near[1]

    def pulses(self, group: str) -> I64:
        """Times of ``event_pulses``, ``arm_pulses``, ``sync_pulses`` or ``exposures``, ns.

        Exposures are empty where the sync box sees none.
        """
        return self._late(f"{group}/t")

    def clock_reads(self, group: str) -> ClockReads:
        """All of ``box_reads`` or ``frame_camera_reads``; empty where nobody read that clock."""
        return ClockReads(*(self._late(f"{group}/{name}") for name in _READS))

    def _late(self, name: str) -> I64:
        """A column of times; empty if it is one of `TIMING` that was never made."""
        if name in TIMING and not self.has(name):
            return np.empty(0, np.int64)
        return self.column(name)

    def poses(self) -> PoseChunk:
        """All arm poses."""
        return PoseChunk(*(self.column(f"poses/{name}") for name in ("t", "host", "xyz", "rotvec")))

    def column(self, name: str) -> Array:
        """One column by its name in the file, such as ``frames/t``; times are int64."""
        values = self._file.rows(name).read()
        return values.astype(np.int64) if name == TIMES else values

    def has(self, name: str) -> bool:
        """Whether the file has a column of this name; those of `TRACKS` and
        `TIMING` may be missing."""
        return self._file.has(name)

    def counts(self) -> dict[str, int]:
        """Rows of every column; 0 for one that is missing."""
        return {
            name: len(self._file.rows(name)) if self.has(name) else 0
            for name in (*COLUMNS, *TRACKS, *TIMING)
        }
