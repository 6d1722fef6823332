"""HDF5 files with events: DSEC's layout, ours, and the lab's with seconds as floats.

A foreign file's columns may be links out of the file, claim more data than any disk holds, or use
unavailable filters. `storage.trials.hdf5_reader` rejects links; sizes are checked against the bytes
of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from sliplab.storage.formats.exported import has_events, recorded_triggers
from sliplab.storage.formats.foreign import (
    LATEST_US,
    Damage,
    ForeignTrial,
    FormatError,
    Triggers,
    as_damage,
    event_chunk,
    read_head,
    resolution_us,
    rounded_us,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import I64, EventChunk, Json
from sliplab.storage.trials.hdf5_reader import FileContent, Hdf5Column, RowFile
from sliplab.storage.trials.hdf5_writer import CACHE_BYTES
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.superblock import SIGNATURE

PIECE = 1 << 18
"""Events that are read at once."""
_SUPERBLOCK, _FLAGS = 52, 12
"""Bytes of a superblock, and of its beginning up to its flags."""
_FEW_ROWS = 1 << 12
_MOST_PACKED = 2000
"""Rows a byte of the file: what columns of equal values are packed to."""
_DSEC_TYPES = {"x": np.uint16, "y": np.uint16, "p": np.uint8, "t": np.uint32}
_LAYOUTS = "dsec has events/x, y, p and t, lab-hdf5 has events/xs, ys, ps and ts"
_FAULTS = (OSError, RuntimeError, KeyError, TypeError, ValueError, MemoryError, AttributeError)


Rows = Callable[[str], Hdf5Column]
"""Opens a column of plain numbers by its name."""
Columns = Mapping[str, Hdf5Column]


@dataclass(frozen=True)
class _Layout:
    """Layout of events in an HDF5 file.

    Attributes:
        keys: columns below ``events``: columns, rows, polarities and times.
        events: makes events of rows of these columns and an offset of the times, us.
        offset: reads that offset.
        properties: reads further attributes of the trial from a file, a function that opens its
            columns, those below ``events``, and the number of their rows; if the last argument is
            true, the file is damaged, and what cannot be read is left out.
    """

    keys: tuple[str, str, str, str]
    events: Callable[[Any, Any, Any, Any, int], EventChunk]
    offset: Callable[[RowFile], int]
    properties: Callable[[RowFile, Rows, Columns, int, bool], Json]

    def read(self, path: Path, name: str) -> ForeignTrial:
        """Read a file of the layout.

        Raises:
            FormatError: it is damaged, or has another layout.
        """
        with _opened(path) as (file, rows):
            columns = self._columns(rows)
            _same_length(columns)
            count = min(map(len, columns.values()))
            with as_damage():
                offset = self.offset(file)
                found = self.properties(file, rows, columns, count, False)
        return self._trial(path, name, count, offset, found)

    def salvage(self, path: Path, name: str) -> ForeignTrial:
        """Read the events before the first piece of a column that cannot be read.

        Raises:
            FormatError: the description of its columns is damaged, or it has another layout.
        """
        with _opened(path, torn=True) as (file, rows):
            columns = self._columns(rows)
            offset = self.offset(file)
            count, lost = _whole_rows(path, columns, partial(self._chunk, columns, offset))
            found = self.properties(file, rows, columns, count, True)
        return self._trial(path, name, count, offset, {**found, "lost": lost}, torn=True)

    def _columns(self, rows: Rows) -> Columns:
        return {key: rows(f"events/{key}") for key in self.keys}

    def _chunk(self, columns: Columns, offset: int, low: int, high: int) -> EventChunk:
        x, y, p, t = (column.read(low, high) for column in columns.values())
        return self.events(x, y, p, t, offset)

    def _trial(
        self, path: Path, name: str, count: int, offset: int, found: Json, *, torn: bool = False
    ) -> ForeignTrial:
        def all_events() -> Iterator[EventChunk]:
            with _opened(path, torn=torn) as (_, rows):
                columns = self._columns(rows)
                for low in range(0, count, PIECE):
                    yield self._chunk(columns, offset, low, min(low + PIECE, count))

        return ForeignTrial(name, path.name, all_events, notes=_open_note(path), **found)


def _dsec_properties(file: RowFile, rows: Rows, columns: Columns, count: int, torn: bool) -> Json:
    triggers = None
    try:
        triggers = _triggers(file, rows)
    except (FormatError, *_FAULTS):
        if not torn:
            raise
    return {
        "epoch": "the event camera's own clock, us",
        "triggers": triggers,
        "simulated": bool(file.attribute("simulated", 0)),
        "unknown": ("sync grade", "poses", "motion", "condition", "frames"),
    }


def _dsec_events(x: Any, y: Any, p: Any, t: Any, offset: int) -> EventChunk:
    return event_chunk(x, y, _polarities(p), _integers(t) + offset)


def _lab_properties(file: RowFile, rows: Rows, columns: Columns, count: int, torn: bool) -> Json:
    size = _resolution(file.integers("sensor_resolution"), columns, count)
    return {
        "epoch": "unknown; seconds as the file has them, rounded to us",
        "event_px": lambda: size,
        "unknown": (
            *("epoch", "sync grade", "poses", "motion", "condition", "frames"),
            "polarity map",
        ),
        "any_order": True,
    }


def _lab_events(x: Any, y: Any, p: Any, t: Any, offset: int) -> EventChunk:
    step_us = resolution_us(t, 1e6, whole_us=1e6)
    return event_chunk(_pixels(x), _pixels(y), _polarities(p), rounded_us(t, 1e6), step_us)


def _offset(file: RowFile) -> int:
    stated = _integers(file.rows("t_offset").read()) if file.has("t_offset") else np.zeros(1)
    if stated.size != 1:
        raise FormatError(f"t_offset has the shape {stated.shape}; one number is right")
    offset = int(stated.reshape(())[()])
    if not 0 <= offset < LATEST_US:
        raise FormatError(f"t_offset = {offset}: is not a time")
    return offset


def _triggers(file: RowFile, rows: Rows) -> Triggers | None:
    if not file.has("triggers/t"):
        return None
    kinds = _integers(rows("triggers/kind").read()).astype(np.uint8)
    found = Triggers(_integers(rows("triggers/t").read()), kinds)
    if len(found.t_us) != len(kinds):
        raise FormatError("holds triggers whose columns have different lengths")
    return found


def _polarities(values: Any) -> Any:
    """Return polarities: 1 and 255 are ON, 0 and -1 OFF, others unknown (2)."""
    found = np.asarray(values)
    if found.dtype.kind == "b":
        return found
    return np.select([np.isin(found, (1, 255)), np.isin(found, (0, -1))], [1, 0], 2)


def _piece(columns: Columns) -> int:
    """Return the rows that are read or lost together: a chunk of the column of times."""
    *_, times = columns.values()
    starts = (low for low, *_ in times.stored())
    with suppress(*_FAULTS):
        next(starts, None)
        return min(next(starts, _FEW_ROWS), _FEW_ROWS)
    return _FEW_ROWS


def _whole_rows(
    path: Path,
    columns: Columns,
    check: Callable[[int, int], object],
) -> tuple[int, Lost | None]:
    """Return the number of rows before the first that cannot be read in all columns.

    Args:
        check: reads rows low to high; raises where they cannot be right.
    """
    size = path.stat().st_size
    lengths = {key: len(column) for key, column in columns.items()}
    given, count = max(lengths.values()), min(lengths.values())
    reason = None if given == count else f"has event columns of different lengths: {lengths}"
    for key, column in columns.items():
        if (row := _rows_inside(column, count, size)) < count:
            count, reason = row, f"is cut short in the column events/{key}, at row {row}"
    low, step = 0, PIECE
    while low < count:
        high = min(low + step, count)
        try:
            check(low, high)
        except (FormatError, *_FAULTS) as error:
            if step > (piece := _piece(columns)):
                step = piece
                continue
            count, reason = low, f"holds rows that cannot be read from row {low} on: {error}"
            break
        low = high
    if reason is None:
        return count, None
    left = [one for column in columns.values() for one in _unread(column, count, size)]
    at = min((place for place, _ in left), default=size)
    unread = sum(length for _, length in left)
    return count, Lost(at_byte=at, unread_bytes=unread, reason=reason, events=given - count)


def _rows_inside(column: Hdf5Column, count: int, size: int) -> int:
    """Return how many of the first `count` rows are in a file of `size` bytes."""
    known = 0
    with suppress(*_FAULTS):  # the file's list of pieces may be damaged itself
        for low, length, place in column.stored():
            known = low
            if low >= count or place is None or place + length > size:
                break
        else:
            known = count
    return min(known, count)


def _unread(column: Hdf5Column, count: int, size: int) -> Iterator[tuple[int, int]]:
    """Yield place and bytes of the pieces with rows from `count` on that the file has."""
    pieces: list[tuple[int, int, int | None]] = []
    with suppress(*_FAULTS):
        pieces.extend(column.stored())
    ends = [*(low for low, *_ in pieces[1:]), len(column)]
    for (_, length, place), end in zip(pieces, ends, strict=False):
        if place is not None and end > count and place < size:
            yield place, min(length, size - place)


def _resolution(stated: list[int] | None, of: Columns, count: int) -> tuple[int, int] | None:
    """Return columns and rows of the camera, by the attribute `sensor_resolution`.

    The lab writes columns first, other programs that share its layout rows first. Sensors are wider
    than high, so the larger number is the columns, unless more events fit the other way.
    """
    if stated is None or len(stated) < 2 or min(stated[:2]) <= 0:
        return None
    long, short = max(stated[:2]), min(stated[:2])
    sizes = ((long, short), (short, long))
    outside = [0, 0]
    for low in range(0, count, PIECE):
        x, y = (_pixels(of[key].read(low, min(low + PIECE, count))) for key in ("xs", "ys"))
        for which, (columns, rows) in enumerate(sizes):
            outside[which] += int(((x >= columns) | (y >= rows)).sum())
    return sizes[int(outside[1] < outside[0])]


def _same_length(columns: Mapping[str, Sized]) -> None:
    """Refuse columns of which one is truncated: the events that it has lost are unknown."""
    lengths = {key: len(column) for key, column in columns.items()}
    if len(set(lengths.values())) > 1:
        stated = ", ".join(f"{key} {count}" for key, count in lengths.items())
        raise FormatError(f"its events' columns have different lengths: {stated}")


def write_dsec(
    path: Path, chunks: Iterable[EventChunk], triggers: Triggers | None, *, simulated: bool
) -> int:
    """Write events in DSEC's layout: Blosc and zstd, ``t`` in 32 bits after ``t_offset``, us.

    Args:
        chunks: events in order of time; each is written before the next one is read.

    Returns:
        Number of events.

    Raises:
        ValueError: the recording is longer than 32 bits of microseconds (71.6 min).
    """
    packing = hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE)
    count = offset = next_ms = 0
    with h5py.File(path, "w", rdcc_nbytes=CACHE_BYTES) as file:
        file.attrs["simulated"] = np.int64(simulated)

        def column(name: str, dtype: Any) -> Any:
            return file.create_dataset(
                name, (0,), dtype, maxshape=(None,), chunks=(1 << 16,), **packing
            )

        events = {key: column(f"events/{key}", dtype) for key, dtype in _DSEC_TYPES.items()}
        index = column("ms_to_idx", np.uint64)
        for chunk in chunks:
            if not len(chunk):
                continue
            offset = offset if count else int(chunk.t_us[0])
            times = chunk.t_us - offset
            if int(times[-1]) >= 1 << 32:
                raise ValueError(
                    "is longer than 71.6 min, which DSEC's 32-bit times cannot represent"
                )
            marks = np.arange(next_ms, int(times[-1]) // 1000 + 1) * 1000
            _append(index, count + np.searchsorted(times, marks))
            for key, values in {"x": chunk.x, "y": chunk.y, "p": chunk.p, "t": times}.items():
                _append(events[key], values)
            next_ms, count = next_ms + len(marks), count + len(chunk)
        _append(index, np.full(1, count))  # so that the last millisecond has an end
        file["t_offset"] = np.int64(offset)
        if triggers is not None:
            _append(column("triggers/t", np.int64), triggers.t_us)
            _append(column("triggers/kind", np.uint8), triggers.kind)
    return count


def _append(column: Any, values: Any) -> None:
    """Add rows to an `h5py.Dataset`."""
    start = len(column)
    column.resize((start + len(values),))
    column[start:] = values


class _opened:
    """An open file, and the function that opens its columns; its faults become `FormatError`.

    Args:
        torn: open truncated files, too, with zeros in place of missing data.
    """

    def __init__(self, path: Path, *, torn: bool = False) -> None:
        self._path, self._torn = path, torn
        self._padded: FileContent | None = None

    def __enter__(self) -> tuple[RowFile, Rows]:
        size = self._path.stat().st_size
        try:
            end = _stated_end(self._path)
            if self._torn and end > size:
                self._padded = FileContent(self._path, end)
            self._file = RowFile(self._path, self._padded)
        except _FAULTS as error:
            self._close()
            if _is_left_open(self._path):
                raise Damage(
                    f"was left open by a program that wrote it, or still is: once none writes it, "
                    f"`h5clear -s {self._path.name}` makes it readable"
                ) from None
            if read_head(self._path).startswith(SIGNATURE):
                cut = f"is cut short: it says that it has {end} bytes, and has {size}"
                raise Damage(cut if end > size else f"is damaged: {error}") from None
            raise FormatError(f"is not an HDF5 file, or is damaged: {error}") from None
        self._most = size * _MOST_PACKED
        return self._file, self._rows

    def __exit__(self, kind: Any, error: BaseException | None, at: Any) -> None:
        try:
            self._file.close()
        finally:
            self._close()
        if isinstance(error, FormatError):
            return
        if isinstance(error, _FAULTS):
            what = str(error).removeprefix(f"{self._path}: ").removeprefix("cannot be read: ")
            raise Damage(f"cannot be read: {what}") from None

    def _close(self) -> None:
        if self._padded is not None:
            self._padded.close()

    def _rows(self, name: str) -> Hdf5Column:
        if not self._file.has(name):
            raise FormatError(f"has no column {name}; {_LAYOUTS}")
        found = self._file.rows(name)
        if len(found.shape) != 1 or found.shape[0] > self._most:
            raise FormatError(f"{name} has the shape {found.shape}")
        return found


def _is_left_open(path: Path) -> bool:
    """Return whether a file says that a program has it open for writing (superblock 2 and 3)."""
    head = read_head(path)[:_FLAGS]
    return len(head) == _FLAGS and head.startswith(SIGNATURE) and head[8] in {2, 3} and head[-1] > 0


def _open_note(path: Path) -> Callable[[], tuple[str, ...]]:
    text = "was left open by its writer, or is still being written: what it holds now is imported"
    return lambda: (text,) if _is_left_open(path) else ()


def _stated_end(path: Path) -> int:
    """Return the number of bytes that a file's header states; 0 if it states none."""
    with path.open("rb") as file:
        head = file.read(_SUPERBLOCK)
    at = {0: 40, 1: 44, 2: 28, 3: 28}.get(head[8] if len(head) == _SUPERBLOCK else -1)
    # versions of the superblock (HDF5 file format, II.A), with places of 8 bytes
    width = head[13:14] if at in {40, 44} else head[9:10]
    if at is None or not head.startswith(SIGNATURE) or width != b"\x08":
        return 0
    return int.from_bytes(head[at : at + 8], "little")


def _integers(values: Any) -> I64:
    found = np.asarray(values)
    if found.dtype.kind not in "iu":
        raise FormatError(
            f"contains times of {found.dtype}, which DSEC's layout has as integers, us; rounded, "
            "in a copy of the file, they can be imported"
        )
    return np.where(found < LATEST_US, found, LATEST_US).astype(np.int64)


def _pixels(values: Any) -> I64:
    found = np.asarray(values)
    if found.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            found = np.where(found == np.rint(found), np.clip(found, -1, 1 << 20), -1)
    return found.astype(np.int64)


def _export(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write events and triggers; DSEC's event file holds no frames."""
    if not has_events(recording, stream):
        raise ValueError("has no events; DSEC's file can store nothing else")
    triggers = recorded_triggers(recording, stream)
    with recording.open(stream) as reader:
        count = write_dsec(path, reader.event_chunks(), triggers, simulated=recording.simulated)
    return {"events": count, "frames": 0, "triggers": len(triggers.t_us)}


def _sniff(path: Path, head: bytes, *, lab: bool) -> bool:
    """Return whether a file is of the layout; a damaged one may be of both."""
    if not head.startswith(SIGNATURE):
        return False
    try:
        with _opened(path, torn=True) as (file, _):
            return file.has("events/ts") == lab
    except FormatError:  # its reader finds the same fault
        return True


_DSEC = _Layout(("x", "y", "p", "t"), _dsec_events, _offset, _dsec_properties)
_LAB = _Layout(("xs", "ys", "ps", "ts"), _lab_events, lambda file: 0, _lab_properties)
_ENDINGS = (".h5", ".hdf5")
DSEC = Format(_ENDINGS, partial(_sniff, lab=False), _DSEC.read, _DSEC.salvage, export=_export)
"""Files with ``events/{x,y,p,t}`` in us and an optional ``t_offset``."""
LAB_HDF5 = Format(_ENDINGS, partial(_sniff, lab=True), _LAB.read, _LAB.salvage)
"""The lab's files with ``events/{ps,ts,xs,ys}``: float seconds, in any order."""
