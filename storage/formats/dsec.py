"""HDF5 files with events: DSEC's layout, ours, and the lab's with seconds as floats.

A foreign file's columns may be links out of the file, claim more data than any disk holds, or use
unavailable filters. `storage.trials.hdf5_reader` rejects links; sizes are checked against the bytes
of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sized
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

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
from sliplab.storage.formats.time_order import is_unordered
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import I64, EventChunk
from sliplab.storage.trials.hdf5_reader import FileContent, Hdf5Column, RowFile
from sliplab.storage.trials.superblock import SIGNATURE

PIECE = 1 << 20
_SUPERBLOCK, _FLAGS = 52, 12
"""Bytes of a superblock, and of its beginning up to its flags."""
_FEW_ROWS = 1 << 12
_LAB = ("xs", "ys", "ps", "ts")
_MOST_PACKED = 2000
"""Rows a byte of the file: what columns of equal values are packed to."""
_MOST_UNSORTED = 1 << 28
_LAYOUTS = "dsec has events/x, y, p and t, lab-hdf5 has events/xs, ys, ps and ts"
_FAULTS = (OSError, RuntimeError, KeyError, TypeError, ValueError, MemoryError, AttributeError)


def read_dsec(path: Path, name: str) -> ForeignTrial:
    """Read a file with ``events/{x,y,p,t}`` in us and an optional ``t_offset``.

    Raises:
        FormatError: it is damaged, or has another layout.
    """
    with _opened(path) as (file, rows):
        columns = {key: rows(f"events/{key}") for key in "xypt"}
        _same_length(columns)
        with as_damage():
            offset = _offset(file)
            triggers = _triggers(file, rows)
        simulated = bool(file.attribute("simulated", 0))
    count = len(columns["t"])

    def all_events() -> Iterator[EventChunk]:
        with _opened(path) as (_, again):
            found = {key: again(f"events/{key}") for key in "xypt"}
            for low in range(0, count, PIECE):
                yield _dsec_events(found, offset, low, low + PIECE)

    return _dsec_trial(path, name, all_events, triggers, simulated)


def salvage_dsec(path: Path, name: str) -> ForeignTrial:
    """Read the events before the first piece of a column that cannot be read.

    Raises:
        FormatError: the description of its columns is damaged, or it has another layout.
    """
    with _opened(path, torn=True) as (file, rows):
        columns = {key: rows(f"events/{key}") for key in "xypt"}
        offset = _offset(file)
        simulated = bool(file.attribute("simulated", 0))
        try:
            triggers = _triggers(file, rows)
        except (FormatError, *_FAULTS):
            triggers = None

        def check(low: int, high: int) -> EventChunk:
            return _dsec_events(columns, offset, low, high)

        count, lost = _whole_rows(path, columns, check)

    def all_events() -> Iterator[EventChunk]:
        with _opened(path, torn=True) as (_, again):
            found = {key: again(f"events/{key}") for key in "xypt"}
            for low in range(0, count, PIECE):
                yield _dsec_events(found, offset, low, min(low + PIECE, count))

    return replace(_dsec_trial(path, name, all_events, triggers, simulated), lost=lost)


def _offset(file: RowFile) -> int:
    stated = _integers(file.rows("t_offset").read()) if file.has("t_offset") else np.zeros(1)
    if stated.size != 1:
        raise FormatError(f"t_offset has the shape {stated.shape}; one number is right")
    offset = int(stated.reshape(())[()])
    if not 0 <= offset < LATEST_US:
        raise FormatError(f"t_offset = {offset}: is not a time")
    return offset


def _triggers(file: RowFile, rows: Callable[[str], Hdf5Column]) -> Triggers | None:
    if not file.has("triggers/t"):
        return None
    kinds = _integers(rows("triggers/kind").read()).astype(np.uint8)
    found = Triggers(_integers(rows("triggers/t").read()), kinds)
    if len(found.t_us) != len(kinds):
        raise FormatError("holds triggers whose columns have different lengths")
    return found


def _dsec_events(columns: Mapping[str, Hdf5Column], offset: int, low: int, high: int) -> EventChunk:
    x, y, p, t = (columns[key].read(low, high) for key in "xypt")
    return event_chunk(x, y, _polarities(p), _integers(t) + offset)


def _dsec_trial(
    path: Path,
    name: str,
    events: Callable[[], Iterator[EventChunk]],
    triggers: Triggers | None,
    simulated: bool,
) -> ForeignTrial:
    return ForeignTrial(
        name,
        path.name,
        events,
        "the event camera's own clock, us",
        triggers=triggers,
        simulated=simulated,
        unknown=("sync grade", "poses", "motion", "condition", "frames"),
        notes=_open_note(path),
    )


def read_lab_hdf5(path: Path, name: str) -> ForeignTrial:
    """Read the lab's file with ``events/{ps,ts,xs,ys}``: float seconds, in any order.

    Raises:
        FormatError: it is damaged, or has another layout.
    """
    with _opened(path) as (file, rows):
        columns = {key: rows(f"events/{key}") for key in _LAB}
        _same_length(columns)
        count = len(columns["ts"])
        if count > _MOST_UNSORTED:
            raise FormatError(f"holds {count} events, too many events to sort")
        with as_damage():
            size = _resolution(file.integers("sensor_resolution"), columns, count)

    def all_events() -> Iterator[EventChunk]:
        with _opened(path) as (_, again):
            yield _sorted(*_lab_events({key: again(f"events/{key}") for key in _LAB}, 0, count))

    return _lab_trial(path, name, all_events, size)


def salvage_lab_hdf5(path: Path, name: str) -> ForeignTrial:
    """Read the rows before the first piece of a column that cannot be read, and sort them.

    Raises:
        FormatError: the description of its columns is damaged, or it has another layout.
    """
    with _opened(path, torn=True) as (file, rows):
        columns = {key: rows(f"events/{key}") for key in _LAB}

        def check(low: int, high: int) -> EventChunk:
            return _sorted(*_lab_events(columns, low, high))

        count, lost = _whole_rows(path, columns, check)
        if count > _MOST_UNSORTED:
            raise FormatError(f"holds {count} events, too many events to sort")
        size = _resolution(file.integers("sensor_resolution"), columns, count)

    def all_events() -> Iterator[EventChunk]:
        with _opened(path, torn=True) as (_, again):
            yield _sorted(*_lab_events({key: again(f"events/{key}") for key in _LAB}, 0, count))

    return replace(_lab_trial(path, name, all_events, size), lost=lost)


def _lab_events(
    columns: Mapping[str, Hdf5Column], low: int, high: int
) -> tuple[I64, I64, Any, I64, float]:
    """Return columns, rows, polarities, times and their resolution, us, as the file orders them."""
    xs, ys, ps, ts = (columns[key].read(low, high) for key in _LAB)
    step_us = resolution_us(ts, 1e6, whole_us=1e6)
    return _pixels(xs), _pixels(ys), _polarities(ps), rounded_us(ts, 1e6), step_us


def _polarities(values: Any) -> Any:
    """Return polarities: 1 and 255 are ON, 0 and -1 OFF, others unknown (2)."""
    found = np.asarray(values)
    if found.dtype.kind == "b":
        return found
    return np.select([np.isin(found, (1, 255)), np.isin(found, (0, -1))], [1, 0], 2)


def _sorted(x: I64, y: I64, p: Any, t_us: I64, resolution: float) -> EventChunk:
    chunk = event_chunk(x, y, p, t_us, resolution)
    if not is_unordered(chunk.t_us, chunk.p > 0):
        return chunk
    return chunk[np.argsort(chunk.t_us, kind="stable")]


def _lab_trial(
    path: Path,
    name: str,
    events: Callable[[], Iterator[EventChunk]],
    size: tuple[int, int] | None,
) -> ForeignTrial:
    return ForeignTrial(
        name,
        path.name,
        events,
        "unknown; seconds as the file has them, rounded to us",
        lambda: size,
        unknown=("epoch", "sync grade", "poses", "motion", "condition", "frames", "polarity map"),
        notes=_open_note(path),
    )


def _piece(columns: Mapping[str, Hdf5Column]) -> int:
    """Return the rows that are read or lost together: a chunk of the column of times."""
    *_, times = columns.values()
    starts = (low for low, *_ in times.stored())
    with suppress(*_FAULTS):
        next(starts, None)
        return min(next(starts, _FEW_ROWS), _FEW_ROWS)
    return _FEW_ROWS


def _whole_rows(
    path: Path,
    columns: Mapping[str, Hdf5Column],
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


def _resolution(
    stated: list[int] | None, of: Mapping[str, Hdf5Column], count: int
) -> tuple[int, int] | None:
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


def is_lab_hdf5(path: Path) -> bool:
    """Return whether a file has the lab's names of columns.

    Raises:
        FormatError: it cannot be opened.
    """
    with _opened(path, torn=True) as (file, _):
        return bool(file.has("events/ts"))


def write_dsec(
    path: Path, events: EventChunk, triggers: Triggers | None, *, simulated: bool
) -> None:
    """Write events in DSEC's layout: Blosc and zstd, ``t`` in 32 bits after ``t_offset``, us.

    Raises:
        ValueError: the recording is longer than 32 bits of microseconds (71.6 min).
    """
    offset = int(events.t_us[0]) if len(events) else 0
    times = events.t_us - offset
    if len(times) and int(times[-1]) >= 1 << 32:
        raise ValueError("is longer than 71.6 min, which DSEC's 32-bit times cannot represent")
    packing = hdf5plugin.Blosc(cname="zstd", clevel=1, shuffle=hdf5plugin.Blosc.SHUFFLE)
    with h5py.File(path, "w") as file:
        file.attrs["simulated"] = np.int64(simulated)

        def put(name: str, values: Any) -> None:
            file.create_dataset(
                name,
                data=values,
                chunks=(1 << 16,) if len(values) else None,
                maxshape=(None,) if len(values) else None,
                **(packing if len(values) else {}),
            )

        put("events/x", events.x)
        put("events/y", events.y)
        put("events/p", events.p)
        put("events/t", times.astype(np.uint32))
        last_ms = int(times[-1]) // 1000 + 1 if len(times) else 0
        put("ms_to_idx", np.searchsorted(times, np.arange(last_ms + 1) * 1000).astype(np.uint64))
        file["t_offset"] = np.int64(offset)
        if triggers is not None:
            put("triggers/t", triggers.t_us)
            put("triggers/kind", triggers.kind)


class _opened:
    """An open file and its columns of plain numbers; its faults become `FormatError`.

    Args:
        torn: open truncated files, too, with zeros in place of missing data.
    """

    def __init__(self, path: Path, *, torn: bool = False) -> None:
        self._path, self._torn = path, torn
        self._padded: FileContent | None = None

    def __enter__(self) -> tuple[RowFile, Callable[[str], Hdf5Column]]:
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
        raise FormatError("contains times that are not integers")
    return np.where(found < LATEST_US, found, LATEST_US).astype(np.int64)


def _pixels(values: Any) -> I64:
    found = np.asarray(values)
    if found.dtype.kind == "f":
        with np.errstate(invalid="ignore"):
            found = np.where(found == np.rint(found), np.clip(found, -1, 1 << 20), -1)
    return found.astype(np.int64)
