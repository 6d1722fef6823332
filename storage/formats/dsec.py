"""HDF5 files with events: DSEC's layout, ours, and the lab's with seconds as floats.

A foreign file's columns may be links out of the file, claim more data than any disk holds, or use
unavailable filters. `storage.trials.hdf5_reader` rejects links; sizes are checked against the bytes
of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sized
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np

from sliplab.storage.formats.foreign import (
    LATEST_US,
    ForeignTrial,
    FormatError,
    Triggers,
    event_chunk,
    rounded_us,
)
from sliplab.storage.streams import I64, EventChunk
from sliplab.storage.trials.hdf5_reader import RowFile, Rows

PIECE = 1 << 20
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
        offset = int(_integers(file.rows("t_offset").read())) if file.has("t_offset") else 0
        if not 0 <= offset < LATEST_US:
            raise FormatError(f"t_offset = {offset}: is not a time")
        triggers = None
        if file.has("triggers/t"):
            kinds = _integers(rows("triggers/kind").read()).astype(np.uint8)
            triggers = Triggers(_integers(rows("triggers/t").read()), kinds)
            _rising(triggers)
        simulated = bool(file.attribute("simulated", 0))
    count = len(columns["t"])

    def all_events() -> Iterator[EventChunk]:
        with _opened(path) as (_, again):
            x, y, p, t = (again(f"events/{key}") for key in "xypt")
            for low in range(0, count, PIECE):
                px, py, sign = (column.read(low, low + PIECE) for column in (x, y, p))
                yield event_chunk(px, py, sign, _integers(t.read(low, low + PIECE)) + offset)

    return ForeignTrial(
        name, path.name, all_events, "the event camera's own clock, us", triggers=triggers,
        simulated=simulated, unknown=("sync grade", "poses", "motion", "condition", "frames"),
    )  # fmt: skip


def read_lab_hdf5(path: Path, name: str) -> ForeignTrial:
    """Read the lab's file with ``events/{ps,ts,xs,ys}``: float seconds, in any order.

    Raises:
        FormatError: it is damaged, or has another layout.
    """
    with _opened(path) as (file, rows):
        columns = {key: rows(f"events/{key}") for key in ("xs", "ys", "ps", "ts")}
        _same_length(columns)
        if len(columns["ts"]) > _MOST_UNSORTED:
            raise FormatError(f"holds {len(columns['ts'])} events, too many events to sort")
        size = _resolution(file.integers("sensor_resolution"), columns["xs"], columns["ys"])

    def all_events() -> Iterator[EventChunk]:
        with _opened(path) as (_, again):
            xs, ys, ps, ts = (again(f"events/{key}").read() for key in ("xs", "ys", "ps", "ts"))
        t_us = rounded_us(ts, 1e6)
        low = int(t_us.min()) if len(t_us) else 0
        if low < 0:
            raise FormatError("contains an event before its own clock started")
        order = np.argsort(t_us, kind="stable")
        polarity = np.asarray(ps) > 0  # the lab's are 0 and 1, or -1 and 1
        yield event_chunk(_pixels(xs)[order], _pixels(ys)[order], polarity[order], t_us[order])

    return ForeignTrial(
        name, path.name, all_events, "unknown; seconds as the file has them, rounded to us",
        lambda: size,
        unknown=("epoch", "sync grade", "poses", "motion", "condition", "frames", "polarity map"),
    )  # fmt: skip


def _resolution(stated: list[int] | None, xs: Rows, ys: Rows) -> tuple[int, int] | None:
    """Return columns and rows of the camera, by the attribute `sensor_resolution`.

    The lab writes columns first, other programs that share its layout rows first. Sensors are wider
    than high, so the larger number is the columns, unless the events fit only the other way.

    Raises:
        FormatError: the events fit neither way.
    """
    if stated is None or len(stated) < 2 or min(stated[:2]) <= 0:
        return None
    long, short = max(stated[:2]), min(stated[:2])
    columns, rows = (_end(column) for column in (xs, ys))
    for size in ((long, short), (short, long)):
        if columns <= size[0] and rows <= size[1]:
            return size
    raise FormatError(
        f"holds events up to column {columns - 1} and row {rows - 1}, outside of its "
        f"sensor_resolution {stated[0]} x {stated[1]}"
    )


def _end(column: Rows) -> int:
    """Return one more than the largest pixel of a column."""
    starts = range(0, len(column), PIECE)
    pieces = (_pixels(column.read(start, start + PIECE)) for start in starts)
    return max((int(piece.max()) + 1 for piece in pieces), default=0)


def _same_length(columns: Mapping[str, Sized]) -> None:
    """Refuse columns of which one is truncated: nobody knows which events it has lost."""
    lengths = {key: len(column) for key, column in columns.items()}
    if len(set(lengths.values())) > 1:
        stated = ", ".join(f"{key} {count}" for key, count in lengths.items())
        raise FormatError(f"its events' columns have different lengths: {stated}")


def is_lab_hdf5(path: Path) -> bool:
    """Return whether a file has the lab's names of columns.

    Raises:
        FormatError: it cannot be opened.
    """
    with _opened(path) as (file, _):
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
            file.create_dataset(name, data=values, chunks=(1 << 16,) if len(values) else None,
                                maxshape=(None,) if len(values) else None,
                                **(packing if len(values) else {}))  # fmt: skip

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
    """An open file and its columns of plain numbers; its faults become `FormatError`."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __enter__(self) -> tuple[RowFile, Callable[[str], Rows]]:
        try:
            self._file = RowFile(self._path)
        except _FAULTS as error:
            raise FormatError(f"is not an HDF5 file, or is damaged: {error}") from None
        self._most = self._path.stat().st_size * _MOST_PACKED
        return self._file, self._rows

    def __exit__(self, kind: Any, error: BaseException | None, at: Any) -> None:
        self._file.close()
        if isinstance(error, FormatError):
            return
        if isinstance(error, _FAULTS):
            raise FormatError(f"cannot be read: {error}") from None

    def _rows(self, name: str) -> Rows:
        if not self._file.has(name):
            raise FormatError(f"has no column {name}; {_LAYOUTS}")
        found = self._file.rows(name)
        if len(found.shape) != 1 or found.shape[0] > self._most:
            raise FormatError(f"{name} has the shape {found.shape}")
        return found


def _integers(values: Any) -> I64:
    found = np.asarray(values)
    if found.dtype.kind not in "iu" or (found.size and int(found.max()) >= 1 << 62):
        raise FormatError("contains times that are not integers")
    return found.astype(np.int64)


def _rising(found: Triggers) -> None:
    t = found.t_us
    wrong = np.any(t < 0) or np.any(t >= LATEST_US) or np.any(t[1:] < t[:-1])
    if len(t) != len(found.kind) or wrong:
        raise FormatError("contains triggers with decreasing or invalid times")


def _pixels(values: Any) -> I64:
    found = np.asarray(values)
    if found.dtype.kind == "f":
        if not np.isfinite(found).all() or np.any(found != np.rint(found)):
            raise FormatError("contains coordinates that are not pixels")
        found = np.clip(found, -1, 1 << 20)
    return found.astype(np.int64)
