"""Reading of a trial's HDF5 file, column by column, through h5py's low-level interface.

h5py's file and dataset objects would double the time to read a window of 30 ms. All data
must be in the file itself: links, external and virtual data are rejected.
"""

from __future__ import annotations

import math
import os
from bisect import bisect_left
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np

from sliplab.storage.errors import StoreError
from sliplab.storage.streams import (
    I64,
    ClockReads,
    EventChunk,
    PoseChunk,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.hdf5_writer import (
    COLUMNS,
    INDEX,
    INDEX_CUT_FORMAT,
    KIND_ATTRIBUTE,
    OFFSET,
    STREAM_GROUP,
    STREAM_NAME,
    STREAMS,
    TIMES,
    TIMING,
    TRACKS,
    UNIT_ATTRIBUTE,
    Array,
)

MOST_STREAMS = 64
"""Named streams that are read of one trial; a file with more is none of ours."""
_BLOCK = 1 << 15
_FEW = 16
_MOST_TEXT = 128
_CACHE_BYTES, _CACHE_SLOTS = 1 << 18, 521
"""Cache of unpacked chunks, a column. A chunk of events fits; with more than the processor's own
cache holds, every chunk would go through main memory."""


@cache
def _access() -> Any:
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)  # as h5py does: columns close with their file
    access.set_cache(0, _CACHE_SLOTS, _CACHE_BYTES, 0.75)
    return access


class RowFile:
    """An HDF5 file that is open for reading.

    Args:
        content: its bytes as an open binary file, read in place of what is at `path`.
        swmr: read beside a program that writes it (single writer, multiple readers).

    Raises:
        OSError: it cannot be opened, or is none.
    """

    def __init__(self, path: Path, content: Any = None, *, swmr: bool = False) -> None:
        self.path = path
        name, access = os.fsencode(path), _access()
        if content is not None:
            access = access.copy()
            access.set_fileobj_driver(h5py.h5fd.fileobj_driver, content)
            name = repr(content).encode()
        flags = h5py.h5f.ACC_RDONLY | (h5py.h5f.ACC_SWMR_READ if swmr else 0)
        self._file = h5py.h5f.open(name, flags, fapl=access)
        self._opened: dict[str, Rows] = {}

    def close(self) -> None:
        """Close it, and every column of it."""
        self._opened.clear()
        self._file.close()

    def attribute(self, name: str, otherwise: int) -> int:
        """An integer attribute of the file."""
        if not h5py.h5a.exists(self._file, name.encode()):
            return otherwise
        value = np.empty((), np.int64)
        h5py.h5a.open(self._file, name.encode()).read(value)
        return int(value)

    def integers(self, name: str) -> list[int] | None:
        """A small attribute of the file with integers in a row; None if there is no such one."""
        if not h5py.h5a.exists(self._file, name.encode()):
            return None
        found = h5py.h5a.open(self._file, name.encode())
        if found.dtype.kind not in "iu" or len(found.shape) != 1 or found.shape[0] > _FEW:
            return None
        values = np.empty(found.shape, found.dtype)
        found.read(values)
        return [int(value) for value in values]

    def streams(self) -> dict[str, str]:
        """Return the kind of every named stream, by name; it is ``""`` where it is unknown.

        Raises:
            ValueError: a stream points outside the file, has a wrong name, or there are too many.
        """
        group = STREAM_GROUP.encode()
        if not self._file.links.exists(group):
            return {}
        found = self._group(STREAM_GROUP)
        if found.get_num_objs() > MOST_STREAMS:
            raise ValueError(f"{self.path}: has more than {MOST_STREAMS} named streams")
        names = sorted(name.decode("utf-8", "replace") for name in found)
        for name in names:
            if not STREAM_NAME.fullmatch(name):
                raise ValueError(f"{self.path}: a stream has the name {name!r}")
        return {name: self._kind(self._group(f"{STREAM_GROUP}/{name}")) for name in names}

    def _group(self, name: str) -> Any:
        at = b""
        for part in name.encode().split(b"/"):
            at += b"/" + part
            if self._file.links.get_info(at).type != h5py.h5l.TYPE_HARD:
                raise ValueError(f"{self.path}: {name} points outside the file")
        found = h5py.h5o.open(self._file, at)
        if not isinstance(found, h5py.h5g.GroupID):
            raise ValueError(f"{self.path}: {name} is no group")
        return found

    @staticmethod
    def _kind(group: Any) -> str:
        """Return a stream's kind; ``""`` where it says none that is known."""
        kind = _text(group, KIND_ATTRIBUTE)
        return kind if kind in STREAMS else ""

    def unit(self, name: str) -> str:
        """Return the unit of a named stream; ``""`` where it says none."""
        return _text(self._group(f"{STREAM_GROUP}/{name}"), UNIT_ATTRIBUTE)

    def has(self, name: str) -> bool:
        """Return whether there is a column of this name."""
        if name in self._opened:
            return True
        parts = name.split("/")
        paths = ("/".join(parts[: end + 1]).encode() for end in range(len(parts)))
        return all(self._file.links.exists(path) for path in paths)

    def rows(self, name: str) -> Rows:
        """Return a column, opened once.

        Raises:
            KeyError: there is none of this name.
            ValueError: its values are not in this file.
        """
        if name not in self._opened:
            self._opened[name] = self._open(name)
        return self._opened[name]

    def _open(self, name: str) -> Rows:
        at = b""
        for part in name.encode().split(b"/"):
            at += b"/" + part
            if self._file.links.get_info(at).type != h5py.h5l.TYPE_HARD:
                raise ValueError(f"{self.path}: {name} points outside the file")
        data = h5py.h5d.open(self._file, at)
        kept = data.get_create_plist()
        if kept.get_layout() == h5py.h5d.VIRTUAL or kept.get_external_count():
            raise ValueError(f"{self.path}: {name} points outside the file")
        return Rows(data)


def _text(group: Any, name: str) -> str:
    """Return a short text among a group's attributes; ``""`` where there is none."""
    if not h5py.h5a.exists(group, name.encode()):
        return ""
    found = h5py.h5a.open(group, name.encode())
    if found.dtype.kind != "S" or found.shape != () or found.dtype.itemsize > _MOST_TEXT:
        return ""
    value = np.empty((), found.dtype)
    found.read(value)
    return bytes(value.item()).decode("utf-8", "replace")


class Rows:
    """One column: a dataset whose first axis is read in ranges.

    Attributes:
        shape: all of it, rows first; () for a single value.
    """

    def __init__(self, data: Any) -> None:
        self._data = data
        self.shape: tuple[int, ...] = data.shape
        self._dtype = data.dtype

    def __len__(self) -> int:
        return self.shape[0]

    def stored(self) -> Iterator[tuple[int, int, int | None]]:
        """Yield the pieces in which the rows are stored: first row, bytes, and place in the file.

        The place is None where the file has none for a piece. Each is read once, for the file's
        index of them may be damaged.
        """
        kept = self._data.get_create_plist()
        row, others = self._dtype.itemsize * math.prod(self.shape[1:]), (0,) * len(self.shape[1:])
        if kept.get_layout() == h5py.h5d.CHUNKED:
            for low in range(0, len(self), kept.get_chunk()[0]):
                found = self._data.get_chunk_info_by_coord((low, *others))
                # in a damaged index that search may find what reading does not, which then returns
                # zeros; this call fails instead
                self._data.read_direct_chunk((low, *others))
                yield low, found.size, found.byte_offset or None
        elif kept.get_layout() == h5py.h5d.CONTIGUOUS:
            place = self._data.get_offset()
            for low in range(0, len(self), _BLOCK):
                rows = min(_BLOCK, len(self) - low)
                yield low, rows * row, None if place is None else place + low * row
        else:  # a few rows, in the header of the column
            yield 0, len(self) * row, 0

    def read(self, low: int = 0, high: int | None = None) -> Array:
        """Read rows low to high, the last one not included; all by default."""
        if not self.shape or (low == 0 and high in {None, self.shape[0]}):
            values = np.empty(self.shape, self._dtype)
            if values.size:
                self._data.read(h5py.h5s.ALL, h5py.h5s.ALL, values)
            return values
        high = min(len(self) if high is None else high, len(self))
        low = min(low, high)
        values = np.empty((high - low, *self.shape[1:]), self._dtype)
        self._read(low, values)
        return values

    def _read(self, low: int, values: Array) -> None:
        """Fill `values` from row `low` on."""
        if values.size:
            place = self._data.get_space()
            place.select_hyperslab((low, *(0 for _ in self.shape[1:])), values.shape)
            self._data.read(h5py.h5s.create_simple(values.shape), place, values)

    def added(self, low: int, high: int, amount: int) -> I64:
        """Read rows low to high of a column of integers, as int64, with `amount` added to each.

        Narrower rows are read into the end of the result and widened from its beginning, block by
        block: fresh memory costs as much as unpacking what goes into it.
        """
        values = np.empty(high - low, np.int64)
        narrow = values.view(self._dtype)[-len(values) :] if len(values) else values
        self._read(low, narrow)
        for start in range(0, len(values), _BLOCK):
            block = values[start : start + _BLOCK]
            block[...] = narrow[start : start + _BLOCK]  # never reaches rows that are still to come
            block += amount
        return values


class StreamReader:
    """A trial's HDF5 file opened for reading; a context manager.

    Raises:
        StoreError: it was written by a newer version.
        ValueError: a column points outside the file.
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

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def event_times(self) -> I64:
        """Return the times of all events on the camera's clock, us."""
        return self._times(0, len(self._file.rows(TIMES)))

    def _times(self, low: int, high: int) -> I64:
        """Return the times of some events on the camera's clock, us."""
        return self._file.rows(TIMES).added(low, high, self.t_offset_us)

    def events(self, start_us: int | None = None, end_us: int | None = None) -> EventChunk:
        """Return the events with start <= t < end on the camera's clock; all by default.

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
        """Return rows that enclose `t_us` after the offset, from the index or behind its end."""
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
        """Return times of ``event_pulses``, ``arm_pulses``, ``sync_pulses`` or ``exposures``, ns.

        Exposures are empty where the sync box sees none.
        """
        return self._late(f"{group}/t")

    def clock_reads(self, group: str) -> ClockReads:
        """Return all of ``box_reads`` or ``frame_camera_reads``; empty without any."""
        return ClockReads(*(self._late(f"{group}/{name}") for name in ("t", "before", "after")))

    def _late(self, name: str) -> I64:
        """Return a column of times; empty if it is one of `TIMING` that was never made."""
        if name in TIMING and not self.has(name):
            return np.empty(0, np.int64)
        return self.column(name)

    def poses(self) -> PoseChunk:
        """Return all arm poses."""
        return PoseChunk(*(self.column(f"poses/{name}") for name in ("t", "host", "xyz", "rotvec")))

    def streams(self) -> dict[str, str]:
        """Return the kind of every named stream, by name; ``""`` for one that is unknown.

        Raises:
            ValueError: what is there is no stream of ours.
        """
        return self._file.streams()

    def wrenches(self, name: str) -> WrenchChunk:
        """Return all forces and torques of a named stream; empty where the trial has none.

        Raises:
            ValueError: the stream is of another kind.
        """
        kind = self._file.streams().get(name)
        if kind is None:
            return WrenchChunk.empty()
        if kind != WrenchChunk.KIND:
            raise ValueError(f"{self._file.path}: stream '{name}' is of kind '{kind}', no wrench")
        return WrenchChunk(**self._fields(name, kind))

    def scalars(self, name: str) -> ScalarChunk:
        """Return all readings of a named stream; empty where the trial has none.

        Raises:
            ValueError: the stream is of another kind.
        """
        kind = self._file.streams().get(name)
        if kind is None:
            return ScalarChunk.empty()
        if kind != ScalarChunk.KIND:
            raise ValueError(f"{self._file.path}: stream '{name}' is of kind '{kind}', no scalar")
        return ScalarChunk(**self._fields(name, kind), unit=self._file.unit(name))

    def _fields(self, name: str, kind: str) -> dict[str, Array]:
        """Return the columns of a named stream, by the field of its chunks."""
        return {
            field: self.column(f"{STREAM_GROUP}/{name}/{part}")
            for part, (field, _) in STREAMS[kind].items()
        }

    def column(self, name: str) -> Array:
        """Return a column by its name in the file, such as ``frames/t``; times are int64."""
        values = self._file.rows(name).read()
        return values.astype(np.int64) if name == TIMES else values

    def has(self, name: str) -> bool:
        """Return whether the file has a column of this name; some of `TRACKS` and `TIMING` have."""
        return self._file.has(name)

    def counts(self) -> dict[str, int]:
        """Count the rows of every column; 0 for one that is missing."""
        return {
            name: len(self._file.rows(name)) if self.has(name) else 0
            for name in (*COLUMNS, *TRACKS, *TIMING)
        }

    def stream_counts(self) -> dict[str, dict[str, int]]:
        """Count the rows of every column of the named streams, by stream and column.

        Raises:
            KeyError: a column is missing.
        """
        return {
            name: {
                part: len(self._file.rows(f"{STREAM_GROUP}/{name}/{part}"))
                for part in STREAMS.get(kind, {})
            }
            for name, kind in self._file.streams().items()
        }
