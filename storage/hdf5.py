"""One HDF5 file a trial for everything but frames, in the event layout of the DSEC data set.

``events/{x,y,p,t}`` with ``ms_to_idx`` and ``t_offset`` opens in the tools that read DSEC; the
other streams stand beside them. Columns are chunked and compressed with bitshuffle and zstd.
Attributes give every column its unit. Files carry no time stamps: the same data are the same bytes.
"""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import numpy.typing as npt

from storage.streams import I64, EventChunk, FrameChunk, PoseChunk, PulseChunk

Array = npt.NDArray[Any]

EVENT_CHUNK = 1 << 16
SMALL_CHUNK = 1 << 10
SMALL_HELD = 1 << 14
"""Rows of small columns that are held back; each write costs more than what is in it."""
FORMAT = 1

# column -> (dtype, trailing shape, unit)
COLUMNS: dict[str, tuple[str, tuple[int, ...], str]] = {
    "events/x": ("uint16", (), "px"),
    "events/y": ("uint16", (), "px"),
    "events/p": ("uint8", (), "1 brighter, 0 darker"),
    "events/t": ("int64", (), "us of the event camera's clock after t_offset"),
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
TRACKS: dict[str, tuple[str, tuple[int, ...], str]] = {
    "tracks/markers": ("float32", (-1, 2), "px, column and row; NaN where a marker was not seen"),
    "tracks/plate": ("float32", (2,), "px, column and row; NaN where the marker was not seen"),
}


class StreamFile:
    """A trial's HDF5 file while it is written; append only."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = h5py.File(path, "w", libver="latest")
        self._file.attrs["format"] = FORMAT
        self._offset: int | None = None
        self._last_us: int | None = None
        self._marks: list[Array] = []
        self._next_ms = 0
        self._pending: dict[str, list[Array]] = {name: [] for name in COLUMNS}
        self._held = dict.fromkeys(COLUMNS, 0)
        self.counts = dict.fromkeys(COLUMNS, 0)
        for name, (dtype, shape, unit) in COLUMNS.items():
            self._create(name, dtype, shape, unit)

    def _create(self, name: str, dtype: str, shape: tuple[int, ...], unit: str) -> None:
        rows = EVENT_CHUNK if name.startswith("events/") else SMALL_CHUNK
        data = self._file.create_dataset(
            name,
            (0, *shape),
            dtype,
            maxshape=(None, *shape),
            chunks=(rows, *shape),
            **hdf5plugin.Bitshuffle(cname="zstd", clevel=3),
        )
        data.attrs["unit"] = unit

    def _append(self, name: str, values: Array) -> None:
        """Gather whole chunks before writing: a partial chunk would be compressed twice."""
        small = not name.startswith("events/")
        rows = SMALL_CHUNK if small else EVENT_CHUNK
        self._pending[name].append(np.asarray(values))
        self._held[name] += len(values)
        self.counts[name] += len(values)
        if self._held[name] >= (SMALL_HELD if small else rows):
            joined = np.concatenate(self._pending[name])
            whole = len(joined) // rows * rows
            self._write(name, joined[:whole])
            self._pending[name] = [joined[whole:]]
            self._held[name] = len(joined) - whole

    def _write(self, name: str, values: Array) -> None:
        data = self._file[name]
        before = data.shape[0]
        data.resize(before + len(values), axis=0)
        data[before:] = values

    def add_events(self, chunk: EventChunk) -> None:
        """Append events.

        Raises:
            ValueError: times run backwards, inside the chunk or against the one before.
        """
        if not len(chunk):
            return
        first, last = int(chunk.t_us[0]), int(chunk.t_us[-1])
        if (self._last_us is not None and first < self._last_us) or np.any(np.diff(chunk.t_us) < 0):
            raise ValueError(f"event times run backwards at {first} us")
        if self._offset is None:
            self._offset = first
        self._last_us = last
        times = chunk.t_us - self._offset
        self._mark(times, int(times[-1]) // 1000 + 1)
        self._append("events/x", chunk.x)
        self._append("events/y", chunk.y)
        self._append("events/p", chunk.p)
        self._append("events/t", times)

    def _mark(self, times: I64, end_ms: int) -> None:
        """Note the first event at or after each millisecond before `end_ms`."""
        marks = np.arange(self._next_ms, end_ms, dtype=np.int64) * 1000
        self._marks.append(self.counts["events/t"] + np.searchsorted(times, marks, side="left"))
        self._next_ms = max(end_ms, self._next_ms)

    def add_pulses(self, group: str, chunk: PulseChunk) -> None:
        """Append pulses to ``event_pulses``, ``arm_pulses`` or ``sync_pulses``."""
        self._append(f"{group}/t", chunk.t_ns)

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
        before, after = self.counts["frames/t"] - len(chunk), self.counts["frames/t"]
        found = {"tracks/markers": chunk.markers_px, "tracks/plate": chunk.plate_px}
        for name, values in found.items():
            if values is None and name not in self.counts:
                continue
            if values is not None and name not in self.counts:
                dtype, _, unit = TRACKS[name]
                self._create(name, dtype, values.shape[1:], unit)
                self._pending[name], self._held[name], self.counts[name] = [], 0, 0
            shape = self._file[name].shape[1:]
            missing = (before if values is not None else after) - self.counts[name]
            if missing:
                self._append(name, np.full((missing, *shape), np.nan, np.float32))
            if values is not None:
                self._append(name, values)

    def finish(self) -> None:
        """Write what is held back and the index, and close the file."""
        for name, parts in self._pending.items():
            if self._held[name]:
                self._write(name, np.concatenate(parts))
            self._held[name] = 0
        # one more mark, so that the last millisecond has an end
        self._marks.append(np.full(1, self.counts["events/t"], np.int64))
        index = np.concatenate(self._marks).astype(np.int64)
        self._file.create_dataset(
            "ms_to_idx", data=index, chunks=True, **hdf5plugin.Bitshuffle(cname="zstd", clevel=3)
        )
        self._file["ms_to_idx"].attrs["unit"] = "index of the first event at or after this ms"
        self._file["t_offset"] = np.int64(self._offset or 0)
        self._file["t_offset"].attrs["unit"] = "us of the event camera's clock"
        self._file.close()

    def abandon(self) -> None:
        """Close the file as it is."""
        self._file.close()


class StreamReader:
    """A trial's HDF5 file opened for reading; a context manager."""

    def __init__(self, path: Path) -> None:
        self._file = h5py.File(path, "r")
        self.t_offset_us = int(self._file["t_offset"][()])

    def __enter__(self) -> StreamReader:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._file.close()

    def events(self, start_us: int | None = None, end_us: int | None = None) -> EventChunk:
        """Events with start <= t < end on the camera's clock; all by default.

        Only the part of the file that holds them is read.
        """
        group = self._file["events"]
        low, high = 0, group["t"].shape[0]
        marks = self._file["ms_to_idx"]
        if start_us is not None and len(marks):
            low = _bracket(marks, start_us - self.t_offset_us, high)[0]
        if end_us is not None and len(marks):
            high = _bracket(marks, end_us - self.t_offset_us, high)[1]
        high = max(low, high)
        times = group["t"][low:high] + self.t_offset_us
        first = 0 if start_us is None else int(np.searchsorted(times, start_us, "left"))
        last = len(times) if end_us is None else int(np.searchsorted(times, end_us, "left"))
        last = max(first, last)
        rows = slice(low + first, low + last)
        return EventChunk(group["x"][rows], group["y"][rows], group["p"][rows], times[first:last])

    def pulses(self, group: str) -> I64:
        """Pulse times of ``event_pulses``, ``arm_pulses`` or ``sync_pulses``, ns."""
        return np.asarray(self._file[f"{group}/t"][:])

    def poses(self) -> PoseChunk:
        """All arm poses."""
        group = self._file["poses"]
        return PoseChunk(group["t"][:], group["host"][:], group["xyz"][:], group["rotvec"][:])

    def column(self, name: str) -> Array:
        """One column by its name in the file, such as ``frames/t``."""
        return np.asarray(self._file[name][:])

    def has(self, name: str) -> bool:
        """Whether the file has a column of this name; those of `TRACKS` may be missing."""
        return name in self._file

    def counts(self) -> dict[str, int]:
        """Rows of every column; 0 for one that is missing."""
        return {
            name: int(self._file[name].shape[0]) if name in self._file else 0
            for name in (*COLUMNS, *TRACKS)
        }


def _bracket(marks: Any, t_us: int, count: int) -> tuple[int, int]:
    """Indices that enclose time `t_us` after the offset, from the millisecond index."""
    ms = t_us // 1000
    low = 0 if ms < 0 else int(marks[ms]) if ms < len(marks) else count
    high = 0 if ms + 1 < 0 else int(marks[ms + 1]) if ms + 1 < len(marks) else count
    return low, high
