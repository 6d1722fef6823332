"""Reading of a trial's HDF5 file, column by column, through h5py's low-level interface.

h5py's file and dataset objects would double the time to read a window of 30 ms. All data
must be in the file itself: links, external and virtual data are rejected. This interface writes
where it is pointed to: shapes and types are checked before anything is read, and never assumed.
"""

from __future__ import annotations

import io
import math
import os
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import product, repeat
from pathlib import Path
from typing import Any, TypeVar

import h5py
import hdf5plugin  # noqa: F401  (registers the filters)
import numpy as np

from sliplab.storage.errors import StoreError, disk_fault, own_fault
from sliplab.storage.streams import (
    I64,
    MOST_COLUMNS,
    SCALAR,
    STREAM_NAME,
    Chunk,
    ClockReads,
    Column,
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
    STREAMS,
    TIMES,
    TIMING,
    TRACKS,
    UNIT_ATTRIBUTE,
    Array,
)
from sliplab.storage.trials.packed_chunks import Filter, unpacked_bytes
from sliplab.storage.trials.superblock import HEAD_BYTES, closed

EVENTS_AT_ONCE = 1 << 18
"""Events of a chunk of `StreamReader.event_chunks`."""
MOST_STREAMS = 64
"""Named streams that are read of one trial; a file with more was not written by SlipLab."""
_BLOCK = 1 << 15
_FEW = 16
_MOST_TEXT = 128
_NUMBERS, _ATTRIBUTES = "biuf", "biufS"
"""Kinds of type of a column and of an attribute, as numpy names them."""
_HDF5_ERRORS = (OSError, RuntimeError, KeyError, TypeError, ValueError, OverflowError, MemoryError)
_LATEST_US = 1 << 60
_LARGE = 1 << 26
"""Bytes that a column may claim without having them in the file."""
_CACHE_BYTES, _CACHE_SLOTS = 1 << 18, 521
"""Cache of unpacked chunks, a column. A chunk of events fits; with more than the processor's own
cache holds, every chunk would go through main memory."""


class _faults:
    """Context manager that turns HDF5's errors into one line; those of the disk stay as they are.

    A class, for a generator would cost as much as a small read.
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: Any, error: BaseException | None, at: Any) -> None:
        if not isinstance(error, _HDF5_ERRORS) or isinstance(error, NotOurs):
            return
        if own_fault(error) or disk_fault(error) is not None:
            return
        raise NotOurs(f"{self._name}: cannot be read: {error}") from error


@cache
def _access() -> Any:
    access = h5py.h5p.create(h5py.h5p.FILE_ACCESS)
    access.set_fclose_degree(h5py.h5f.CLOSE_STRONG)  # as h5py does: columns close with their file
    access.set_cache(0, _CACHE_SLOTS, _CACHE_BYTES, 0.75)
    return access


class NotOurs(StoreError, ValueError):
    """A file that claims to be a trial's has something else where its data should be."""


class NoColumn(NotOurs):
    """A file lacks a column."""


class FileContent(io.RawIOBase):
    """Bytes of a file, read by Python: HDF5's locks and flags do not matter.

    Args:
        size: bytes; zeros are in place of those that the file lacks. None for those that it has.
        head: in place of its first bytes.
    """

    def __init__(self, path: Path, size: int | None = None, head: bytes = b"") -> None:
        self._file, self._head, self._at = path.open("rb"), head, 0
        self._size = os.fstat(self._file.fileno()).st_size if size is None else size

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        self._at = offset + {io.SEEK_SET: 0, io.SEEK_CUR: self._at}.get(whence, self._size)
        return self._at

    def readinto(self, buffer: Any) -> int:
        room = memoryview(buffer).cast("B")
        self._file.seek(self._at)
        filled = self._file.readinto(room)
        room[filled:] = bytes(len(room) - filled)
        head = self._head[self._at : self._at + len(room)]
        room[: len(head)] = head
        self._at += len(room)
        return len(room)

    def close(self) -> None:
        self._file.close()
        super().close()


class RowFile:
    """An HDF5 file that is open for reading.

    A file that another program has open, or this one in another mode, is read all the same.

    Args:
        content: its bytes as an open binary file, read in place of what is at `path`.

    Raises:
        OSError: it cannot be opened, or is not an HDF5 file.
    """

    def __init__(self, path: Path, content: Any = None) -> None:
        self.path = path
        self._own: FileContent | None = None
        self._opened: dict[str, Hdf5Column] = {}
        self._own_parts = set[bytes]()
        if content is not None:
            self._file = _open_content(content)
            return
        try:
            self._file = h5py.h5f.open(os.fsencode(path), h5py.h5f.ACC_RDONLY, fapl=_access())
        except OSError as error:
            # a lock, a flag that a dead program left, or another mode in this program
            if own_fault(error) or not path.is_file():
                raise
            try:
                with path.open("rb") as file:
                    head = closed(file.read(HEAD_BYTES)) or b""
                self._own = FileContent(path, head=head)
                self._file = _open_content(self._own)
            except OSError:
                if self._own is not None:
                    self._own.close()
                raise error from None

    def close(self) -> None:
        """Close it, and every column of it."""
        self._opened.clear()
        self._file.close()
        if self._own is not None:
            self._own.close()

    def attribute(self, name: str, otherwise: int) -> int:
        """Return an integer attribute of the file.

        Raises:
            NotOurs: it is not one integer.
        """
        with _faults(str(self.path)):
            found = _attribute(self._file, name)
        if found is None:
            return otherwise
        if found.dtype.kind not in "biu" or found.size != 1:
            raise NotOurs(f"{self.path}: attribute '{name}' is not one integer")
        return int(found.reshape(-1)[0])

    def integers(self, name: str) -> list[int] | None:
        """A small attribute of the file with integers in a row; None if there is no such one."""
        try:
            found = _attribute(self._file, name)
        except ValueError:
            return None
        if found is None or found.dtype.kind not in "iu" or found.ndim != 1:
            return None
        return [int(value) for value in found]

    def streams(self) -> dict[str, str]:
        """Return the kind of every named stream, by name; it is ``""`` where it is unknown.

        Raises:
            NotOurs: a stream points outside the file, has a wrong name, or there are too many.
        """
        group = STREAM_GROUP.encode()
        if not self._file.links.exists(group):
            return {}
        found = self._group(STREAM_GROUP)
        if found.get_num_objs() > MOST_STREAMS:
            raise NotOurs(f"{self.path}: has more than {MOST_STREAMS} named streams")
        names = sorted(name.decode("utf-8", "replace") for name in found)
        for name in names:
            if not STREAM_NAME.fullmatch(name):
                raise NotOurs(f"{self.path}: a stream has the name {name!r}")
        return {name: self.kind(f"{STREAM_GROUP}/{name}") for name in names}

    def _group(self, name: str) -> Any:
        found = h5py.h5o.open(self._file, self._place(name))
        if not isinstance(found, h5py.h5g.GroupID):
            raise NotOurs(f"{self.path}: {name} is no group")
        return found

    def kind(self, group: str) -> str:
        """Return the kind of a named stream by the name of its group; ``""`` where it says none."""
        with _faults(f"{self.path}: {group}"):
            kind = _text(self._group(group), KIND_ATTRIBUTE)
        return kind if STREAM_NAME.fullmatch(kind) else ""

    def parts(self, name: str) -> list[str]:
        """Return the names of a named stream's columns; of a kind not known here what it has.

        Raises:
            NotOurs: it has a wrong name, or there are too many.
        """
        kind = self.kind(f"{STREAM_GROUP}/{name}")
        if kind in STREAMS or not kind:
            return list(STREAMS[kind].columns) if kind else []
        group = self._group(f"{STREAM_GROUP}/{name}")
        if group.get_num_objs() > MOST_COLUMNS:
            raise NotOurs(f"{self.path}: stream '{name}' has more than {MOST_COLUMNS} columns")
        found = [part.decode("utf-8", "replace") for part in group]
        for part in found:
            if not STREAM_NAME.fullmatch(part):
                raise NotOurs(f"{self.path}: stream '{name}' has a column {part!r}")
        return sorted(found)

    def unit(self, name: str) -> str:
        """Return the unit of a named stream; ``""`` where it says none."""
        return _text(self._group(f"{STREAM_GROUP}/{name}"), UNIT_ATTRIBUTE)

    def column_unit(self, name: str, part: str) -> str:
        """Return the unit of a column of a named stream; ``""`` where it says none."""
        kind = self.kind(group := f"{STREAM_GROUP}/{name}")
        if kind == SCALAR.name and part == "value":
            return self.unit(name)
        if kind in STREAMS:
            return STREAMS[kind].columns[part].unit
        return _text(self._group(group), f"{UNIT_ATTRIBUTE}_{part}")

    def has(self, name: str) -> bool:
        """Return whether there is a column of this name, or something that cannot be read."""
        if name in self._opened:
            return True
        try:
            self._place(name)
        except NoColumn:
            return False
        except NotOurs:
            pass
        return True

    def rows(self, name: str) -> Hdf5Column:
        """Return a column, opened once.

        Raises:
            NoColumn: there is none of this name.
            NotOurs: its values are not in this file, or not numbers.
        """
        if name not in self._opened:
            with _faults(f"{self.path}: {name}"):
                self._opened[name] = self._open(name)
        return self._opened[name]

    def _open(self, name: str) -> Hdf5Column:
        data = h5py.h5o.open(self._file, self._place(name))
        if not isinstance(data, h5py.h5d.DatasetID):
            raise NotOurs(f"{self.path}: {name} is no column")
        retained = data.get_create_plist()
        layout = retained.get_layout()
        if layout == h5py.h5d.VIRTUAL or retained.get_external_count():
            raise NotOurs(f"{self.path}: {name} points outside the file")
        if (dtype := _plain(data, _NUMBERS)) is None:
            raise NotOurs(f"{self.path}: {name} does not contain numbers")
        rows = Hdf5Column(data, f"{self.path}: {name}", dtype)
        value = rows.dtype.itemsize
        stated = value * math.prod(rows.shape)
        if stated > _LARGE and (stored := _stored_bytes(data, retained)) < stated:
            raise NotOurs(f"{self.path}: {name} has {stored} of its {stated} bytes")
        if layout == h5py.h5d.CHUNKED:
            chunk = retained.get_chunk()
            if max(_LARGE, 2 * stated) < value * math.prod(chunk):
                raise NotOurs(
                    f"{self.path}: {name} is stored in pieces of {chunk} for {rows.shape}"
                )
            filters = [retained.get_filter(number) for number in range(retained.get_nfilters())]
            rows.pack(chunk, [(kind, options) for kind, _, options, _ in filters])
        return rows

    def _place(self, name: str) -> bytes:
        """Return the full path of something in the file itself.

        Raises:
            NoColumn: there is none of this name.
            NotOurs: a part of the path is a link.
        """
        at = b""
        for part in name.encode().split(b"/"):
            at += b"/" + part
            if at in self._own_parts:
                continue
            with _faults(f"{self.path}: {name}"):  # its group may be something else
                there = self._file.links.exists(at)
            if not there:
                raise NoColumn(f"{self.path}: has no {name}")
            if self._file.links.get_info(at).type != h5py.h5l.TYPE_HARD:
                raise NotOurs(f"{self.path}: {name} points outside the file")
            self._own_parts.add(at)
        return at


def _open_content(content: Any) -> Any:
    """Open an HDF5 file that is read through an open binary file."""
    access = _access().copy()
    access.set_fileobj_driver(h5py.h5fd.fileobj_driver, content)
    return h5py.h5f.open(repr(content).encode(), h5py.h5f.ACC_RDONLY, fapl=access)


def _plain(found: Any, kinds: str) -> np.dtype[Any] | None:
    """Return the type of a dataset's or an attribute's values; None where it is of no such kind."""
    try:
        dtype: np.dtype[Any] = found.dtype
    except TypeError:  # one that numpy has no type for
        return None
    if dtype.kind not in kinds or found.get_space().get_simple_extent_type() == h5py.h5s.NULL:
        return None
    return dtype


def _stored_bytes(data: Any, retained: Any) -> int:
    """Return how many bytes of a dataset are in the file, at most, once they are unpacked."""
    if retained.get_layout() != h5py.h5d.CHUNKED:
        return int(data.get_storage_size())
    return int(data.get_num_chunks() * math.prod(retained.get_chunk()) * data.dtype.itemsize)


def _attribute(of: Any, name: str) -> Array | None:
    """Return a small attribute; None if there is none of this name.

    Raises:
        ValueError: it has many values, or none of a plain type.
    """
    if not h5py.h5a.exists(of, name.encode()):
        return None
    found = h5py.h5a.open(of, name.encode())
    dtype = _plain(found, _ATTRIBUTES)
    if dtype is None or math.prod(found.shape) > _FEW:
        raise ValueError(f"attribute '{name}' is not a few plain values")
    if dtype.itemsize > _MOST_TEXT:
        raise ValueError(f"attribute '{name}' is longer than {_MOST_TEXT} bytes")
    values = np.empty(found.shape, dtype)
    found.read(values)
    return values


def _text(group: Any, name: str) -> str:
    """Return a short text among a group's attributes; ``""`` where there is none."""
    try:
        found = _attribute(group, name)
    except ValueError:
        return ""
    if found is None or found.dtype.kind != "S" or found.shape != ():
        return ""
    return bytes(found.item()).decode("utf-8", "replace")


_ANY = "integer"
_OFFSET = Column("", _ANY, (), "us")
_KINDS: dict[str, Column] = {
    **COLUMNS,
    **TRACKS,
    **TIMING,
    TIMES: Column("t_us", _ANY, (), "us"),
    INDEX: Column("", _ANY, (), "row"),
    OFFSET: _OFFSET,
}
_CLOCKS = {part: SCALAR.columns[part] for part in ("t", "host")}
"""Columns of a named stream of any kind."""
ChunkT = TypeVar("ChunkT", bound=Chunk)


class Hdf5Column:
    """One column: a dataset whose first axis is read in ranges.

    Attributes:
        shape: all of it, rows first; () for a single value.
        dtype: of its values.
    """

    def __init__(self, data: Any, name: str, dtype: np.dtype[Any]) -> None:
        self._data, self._name = data, name
        self._chunk: tuple[int, ...] = ()
        self._filters: Sequence[Filter] = ()
        self._fine = set[tuple[int, ...]]()
        self.shape: tuple[int, ...] = data.shape
        self.dtype = dtype

    def pack(self, chunk: tuple[int, ...], filters: Sequence[Filter]) -> None:
        """State how it is stored, so that each chunk's length is checked before it is read.

        Args:
            chunk: values in each direction that are stored together.
            filters: what chunks are packed with; without any they have the right length.
        """
        if filters:
            self._chunk, self._filters = chunk, filters

    def fits(self, column: Column) -> bool:
        """Return whether type and shape are a column's; of ``integer`` any integers are."""
        shape = column.shape
        same = self.dtype.kind in "iu" if column.dtype == _ANY else self.dtype == column.dtype
        rest = self.shape[1:] if column is not _OFFSET else self.shape
        fits = len(rest) == len(shape) and all(
            wanted in {-1, found} for wanted, found in zip(shape, rest, strict=True)
        )
        return same and fits and (column is _OFFSET or bool(self.shape))

    def __len__(self) -> int:
        return self.shape[0]

    def stored(self) -> Iterator[tuple[int, int, int | None]]:
        """Yield the pieces in which the rows are stored: first row, bytes, and place in the file.

        The place is None where the file has none for a piece. Each is read once, for the file's
        index of them may be damaged.
        """
        retained = self._data.get_create_plist()
        row, others = self.dtype.itemsize * math.prod(self.shape[1:]), (0,) * len(self.shape[1:])
        if retained.get_layout() == h5py.h5d.CHUNKED:
            for low in range(0, len(self), retained.get_chunk()[0]):
                found = self._data.get_chunk_info_by_coord((low, *others))
                # in a damaged index that search may find what reading does not, which then returns
                # zeros; this call fails instead
                self._data.read_direct_chunk((low, *others))
                yield low, found.size, found.byte_offset or None
        elif retained.get_layout() == h5py.h5d.CONTIGUOUS:
            place = self._data.get_offset()
            for low in range(0, len(self), _BLOCK):
                rows = min(_BLOCK, len(self) - low)
                yield low, rows * row, None if place is None else place + low * row
        else:  # a few rows, in the header of the column
            yield 0, len(self) * row, 0

    def read(self, low: int = 0, high: int | None = None) -> Array:
        """Read rows low to high, the last one not included; all by default."""
        if not self.shape or (low == 0 and high in {None, self.shape[0]}):
            values = np.empty(self.shape, self.dtype)
            if values.size:
                with _faults(self._name):
                    self._check_chunks(0, len(values) if self.shape else 0)
                    self._data.read(_room(values), h5py.h5s.ALL, values)
            return values
        high = min(len(self) if high is None else high, len(self))
        low = min(low, high)
        values = np.empty((high - low, *self.shape[1:]), self.dtype)
        self._read(low, values)
        return values

    def _read(self, low: int, values: Array) -> None:
        """Fill `values` from row `low` on."""
        if values.size:
            with _faults(self._name):
                self._check_chunks(low, low + len(values))
                place = self._data.get_space()
                place.select_hyperslab((low, *(0 for _ in self.shape[1:])), values.shape)
                self._data.read(_room(values), place, values)

    def _check_chunks(self, low: int, high: int) -> None:
        """Check once that each chunk with some of the rows is as long as it has to be.

        Raises:
            NotOurs: HDF5 would read beyond it.
        """
        if not self._chunk:
            return
        step = self._chunk[0]
        others = map(range, repeat(0), self.shape[1:], self._chunk[1:])
        full = self.dtype.itemsize * math.prod(self._chunk)
        for at in product(range(low // step * step, high, step), *others):
            if at in self._fine:
                continue
            if (chunk := self._stored_chunk(at)) is not None:
                found = unpacked_bytes(self._filters, *chunk, full)
                if found is not None and found < full:
                    raise NotOurs(
                        f"{self._name} has a chunk of {found} bytes, not {full}, at row {at[0]}"
                    )
            self._fine.add(at)

    def _stored_chunk(self, at: tuple[int, ...]) -> tuple[int, bytes] | None:
        """Return the filters that a chunk skipped, and its bytes; None where nothing is stored."""
        try:
            mask, data = self._data.read_direct_chunk(at)
        except _HDF5_ERRORS:
            # asked only now: HDF5 goes through all chunks to answer it
            if self._data.get_chunk_info_by_coord(at).byte_offset is None:
                return None
            raise
        return mask, data

    def added(self, low: int, high: int, amount: int) -> I64:
        """Read rows low to high of a column of integers, as int64, with `amount` added to each.

        Narrower rows are read into the end of the result and widened from its beginning, block by
        block: fresh memory costs as much as unpacking what goes into it.

        Raises:
            NotOurs: it is no column of single integers.
        """
        if len(self.shape) != 1 or self.dtype.kind not in "iu":
            raise NotOurs(f"{self._name} has the type {self.dtype} and the shape {self.shape}")
        values = np.empty(high - low, np.int64)
        narrow = values.view(self.dtype)[-len(values) :] if len(values) else values
        self._read(low, narrow)
        for start in range(0, len(values), _BLOCK):
            block = values[start : start + _BLOCK]
            block[...] = narrow[start : start + _BLOCK]  # never reaches rows that are still to come
            block += amount
        return values


def _room(values: Array) -> Any:
    """Return the extent of an array: HDF5 then writes no further than that."""
    return h5py.h5s.create_simple(values.shape) if values.shape else _SINGLE


_SINGLE = h5py.h5s.create(h5py.h5s.SCALAR)


class StreamReader:
    """A trial's HDF5 file opened for reading; a context manager.

    Args:
        size_px: columns and rows of the event camera; None where they are unknown.

    Raises:
        StoreError: it was written by a newer version.
        NotOurs: its columns are not those of a trial.
    """

    def __init__(self, path: Path, size_px: tuple[int, int] | None = None) -> None:
        self._size_px = size_px
        with _faults(str(path)):
            self._file = RowFile(path)
        try:
            found = self._file.attribute("format", 1)
            if found > INDEX_CUT_FORMAT:
                raise StoreError(
                    f"{path}: format = {found}: was written by a newer version of SlipLab; this "
                    f"one reads formats up to {INDEX_CUT_FORMAT}: update it"
                )
            self._index_cut = found == INDEX_CUT_FORMAT
            self.t_offset_us = int(self._rows(OFFSET).read())
            if abs(self.t_offset_us) > _LATEST_US:
                raise NotOurs(f"{path}: {OFFSET} = {self.t_offset_us}: is no time in us")
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> StreamReader:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def _rows(self, name: str) -> Hdf5Column:
        """Return a column, which is of the type and shape that belong to its name.

        Raises:
            NoColumn: there is none of this name.
            NotOurs: its values are not in this file, or are of another type or shape.
        """
        found = self._file.rows(name)
        column = self._column_of(name)
        if not (bool(found.shape) if column is None else found.fits(column)):
            raise NotOurs(
                f"{self._file.path}: {name} has the type {found.dtype} and the shape {found.shape}"
            )
        return found

    def _column_of(self, name: str) -> Column | None:
        """Return what a column must be; None where that is not known here."""
        group, _, part = name.rpartition("/")
        if not group.startswith(f"{STREAM_GROUP}/"):
            return _KINDS.get(name)
        kind = STREAMS.get(self._file.kind(group))
        return (_CLOCKS if kind is None else kind.columns).get(part)

    def event_times(self) -> I64:
        """Return the times of all events on the camera's clock, us."""
        return self._times(0, len(self._rows(TIMES)))

    def _times(self, low: int, high: int) -> I64:
        """Return the times of some events on the camera's clock, us."""
        return self._rows(TIMES).added(low, high, self.t_offset_us)

    def events(self, start_us: int | None = None, end_us: int | None = None) -> EventChunk:
        """Return the events with start <= t < end on the camera's clock; all by default.

        Only the part of the file that holds them is read.
        """
        x, y, p, t = self._group("events", "x", "y", "p", "t")
        low, high = 0, len(t)
        marks = self._rows(INDEX)
        if start_us is not None and len(marks):
            low = self._bracket(marks, start_us - self.t_offset_us, high)[0]
        if end_us is not None and len(marks):
            high = self._bracket(marks, end_us - self.t_offset_us, high)[1]
        low, high = (min(max(row, 0), len(t)) for row in (low, high))  # of the index, as it is
        high = max(low, high)
        times = self._times(low, high)
        first = 0 if start_us is None else int(np.searchsorted(times, start_us, "left"))
        last = len(times) if end_us is None else int(np.searchsorted(times, end_us, "left"))
        last = max(first, last)
        low, high = low + first, low + last
        found = EventChunk(
            x.read(low, high), y.read(low, high), p.read(low, high), times[first:last]
        )
        self._check_pixels(found)
        return found

    def event_chunks(self) -> Iterator[EventChunk]:
        """Yield all events, `EVENTS_AT_ONCE` of them at a time."""
        x, y, p, t = self._group("events", "x", "y", "p", "t")
        for low in range(0, len(t), EVENTS_AT_ONCE):
            high = min(low + EVENTS_AT_ONCE, len(t))
            found = EventChunk(
                x.read(low, high), y.read(low, high), p.read(low, high), self._times(low, high)
            )
            self._check_pixels(found)
            yield found

    def _check_pixels(self, found: EventChunk) -> None:
        """Refuse events outside of the camera: what counts them by pixel relies on it.

        Raises:
            NotOurs: there is one.
        """
        if self._size_px is None or not len(found):
            return
        last = int(found.x.max()), int(found.y.max())
        if last[0] >= self._size_px[0] or last[1] >= self._size_px[1]:
            raise NotOurs(
                f"{self._file.path}: has events up to column {last[0]} and row {last[1]}, outside "
                f"of its camera of {self._size_px[0]} x {self._size_px[1]} px"
            )

    def _group(self, group: str, *parts: str) -> list[Hdf5Column]:
        """Return columns that have the same number of rows.

        Raises:
            NotOurs: they have not.
        """
        found = [self._rows(f"{group}/{part}") for part in parts]
        if len({len(rows) for rows in found}) > 1:
            lengths = dict(zip(parts, map(len, found), strict=True))
            raise NotOurs(f"{self._file.path}: {group} has columns of different lengths: {lengths}")
        return found

    def _bracket(self, marks: Hdf5Column, t_us: int, count: int) -> tuple[int, int]:
        """Return rows that enclose `t_us` after the offset, from the index or behind its end."""
        ms = t_us // 1000
        near = marks.read(max(0, ms), max(0, ms + 2)).tolist()  # shorter at the end
        if ms < 0:
            return 0, near[0] if ms == -1 and near else 0
        if self._index_cut and len(near) < 2:
            times = self._rows(TIMES)
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
        there = any(self.has(f"{group}/{part}") for part in ClockReads.KIND.columns)
        return self._chunk(ClockReads, group) if there else ClockReads.empty()

    def _late(self, name: str) -> I64:
        """Return a column of times; empty if it is one of `TIMING` that was never made."""
        if name in TIMING and not self.has(name):
            return np.empty(0, np.int64)
        return self.column(name)

    def poses(self) -> PoseChunk:
        """Return all arm poses."""
        return self._chunk(PoseChunk, "poses")

    def _chunk(self, chunk: type[ChunkT], group: str) -> ChunkT:
        """Return all rows of a group as one chunk."""
        columns = chunk.KIND.columns
        rows = self._group(group, *columns)
        return chunk.from_columns({part: r.read() for part, r in zip(columns, rows, strict=True)})

    def streams(self) -> dict[str, str]:
        """Return the kind of every named stream, by name; ``""`` for one that is unknown.

        Raises:
            NotOurs: the group is not a stream written by SlipLab.
        """
        return self._file.streams()

    def wrenches(self, name: str) -> WrenchChunk:
        """Return all forces and torques of a named stream; empty where the trial has none.

        Raises:
            NotOurs: the stream is of another kind.
        """
        return self._named(WrenchChunk, name)

    def scalars(self, name: str) -> ScalarChunk:
        """Return all readings of a named stream; empty where the trial has none.

        Raises:
            NotOurs: the stream is of another kind.
        """
        unit = self._file.unit(name) if name in self.streams() else ""
        return replace(self._named(ScalarChunk, name), unit=unit)

    def _named(self, chunk: type[ChunkT], name: str) -> ChunkT:
        kind, wanted = self.streams().get(name), chunk.KIND.name
        if kind is None:
            return chunk.empty()
        if kind != wanted:
            raise NotOurs(f"{self._file.path}: stream '{name}' is of kind '{kind}', no {wanted}")
        return self._chunk(chunk, f"{STREAM_GROUP}/{name}")

    def parts(self, name: str) -> list[str]:
        """Return the names of a named stream's columns.

        Raises:
            NotOurs: there is no such stream, or one of them is no column.
        """
        return self._file.parts(name)

    def stream(self, name: str) -> dict[str, Array]:
        """Return all rows of a named stream of any kind, by column.

        Raises:
            NotOurs: there is no such stream, or it is none that SlipLab wrote.
        """
        parts = self.parts(name)
        rows = self._group(f"{STREAM_GROUP}/{name}", *parts)
        return {part: column.read() for part, column in zip(parts, rows, strict=True)}

    def column_unit(self, name: str, part: str) -> str:
        """Return the unit of a column of a named stream; ``""`` where it says none."""
        return self._file.column_unit(name, part)

    def column(self, name: str) -> Array:
        """Return a column by its name in the file, such as ``frames/t``; times are int64."""
        values = self._rows(name).read()
        return values.astype(np.int64) if name == TIMES else values

    def column_parts(self, name: str) -> Iterator[Array]:
        """Yield a column, `EVENTS_AT_ONCE` of its rows at a time; times are int64."""
        rows = self._rows(name)
        for low in range(0, len(rows), EVENTS_AT_ONCE):
            values = rows.read(low, min(low + EVENTS_AT_ONCE, len(rows)))
            yield values.astype(np.int64) if name == TIMES else values

    def has(self, name: str) -> bool:
        """Return whether the file has a column of this name; some of `TRACKS` and `TIMING` have."""
        return self._file.has(name)

    def counts(self) -> dict[str, int]:
        """Count the rows of every column; 0 for one that is missing."""
        return {
            name: len(self._rows(name)) if self.has(name) else 0
            for name in (*COLUMNS, *TRACKS, *TIMING)
        }

    def stream_counts(self) -> dict[str, dict[str, int]]:
        """Count the rows of every column of the named streams, by stream and column.

        Raises:
            NoColumn: a column is missing.
        """
        return {
            name: {
                part: len(self._rows(f"{STREAM_GROUP}/{name}/{part}")) for part in self.parts(name)
            }
            for name in self.streams()
        }
