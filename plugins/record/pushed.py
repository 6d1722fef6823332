"""Streams that a program pushes: numbers, events or frames, from any thread."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from sliplab.plugins.record.table import MOST_NS, PULSES, rows, table_kind
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import (
    EVENTS_KIND,
    FRAMES_KIND,
    I64,
    SCALAR,
    Chunk,
    EventChunk,
    FrameChunk,
    Json,
)

MOST_BYTES = 256 * 10**6
"""Pushed data that wait to be written; more are lost, and counted."""
READ_BYTES = 16 * 10**6
"""Data that are read at once, so that a program that pushes too fast costs no more memory."""
LATE_NS = 500_000_000
"""Rows wait so long for older ones, of a slow thread; ones that are older by more fell back."""
_WHOLE = 2**53
_DAY_NS = 86_400 * 10**9


class PushedStream:
    """A `Sensor`, or a camera, whose data a program pushes.

    Args:
        columns: of numbers: the unit of each column by its name.
        kind: ``events`` or ``frames`` instead of columns.
        host_clock: times are those of ``time.monotonic_ns()``.
    """

    def __init__(
        self,
        name: str,
        columns: Mapping[str, str] | None,
        kind: str | None = None,
        size_px: tuple[int, int] | None = None,
        host_clock: bool = True,
    ) -> None:
        self._name, self._size, self._host_clock = name, size_px, host_clock
        self._camera = kind
        self.columns = tuple(columns or ())
        self.unit = ""
        self.kind = None
        if columns is not None:
            one = len(columns) == 1 and not columns.keys() & set(PULSES)
            self.kind = SCALAR if one else table_kind(columns)
            self.unit = next(iter(columns.values())) if one else ""
        self._lock = threading.Lock()
        self._running = False
        self._reset()

    def _reset(self) -> None:
        self._parts: deque[tuple[int, Chunk]] = deque()  # and when they were pushed
        self._bytes = self._number = 0
        self._newest: int | None = None
        self._unordered = self._fell = False
        self._last: int | None = None
        self.lost = self.late = 0

    def empty(self) -> Chunk:
        """Return a chunk without rows."""
        if self._camera == EVENTS_KIND:
            return EventChunk.empty()
        if self._camera == FRAMES_KIND:
            return FrameChunk.empty()
        assert self.kind is not None
        return rows(self.kind, self.unit, dict.fromkeys(self.kind.columns, ()))

    def connect(self) -> None:
        """Nothing has to be opened."""

    def start(self) -> None:
        """Take what is pushed from now on."""
        with self._lock:
            self._reset()
            self._running = True

    def stop(self) -> None:
        """Take no more."""
        with self._lock:
            self._running = False

    def close(self) -> None:
        """Take no more."""
        self.stop()

    def describe(self) -> Json:
        """Return the counts of rows that were not recorded."""
        return {"counts": {"lost": self.lost, "late": self.late}}

    def push(self, t: Any, *values: Any, **named: Any) -> None:
        """Add a row, or a block of rows; from any thread.

        Args:
            t: time, or times of shape (n,), ns; of events us. None is now.
            values: of each column a number, or numbers of shape (n,); of events ``x, y, p``; of
                frames images of shape (n, height, width), uint8.
            named: the same by name.

        Raises:
            InputError: other columns than the stream has, or times of another clock.
            RuntimeError: no trial is being recorded.
        """
        now = time.monotonic_ns()
        chunk = self._chunk(now, t, values, named)
        size = _bytes(chunk)
        with self._lock:
            if not self._running:
                raise RuntimeError(f"stream '{self._name}': no trial is being recorded")
            if self._bytes + size > MOST_BYTES:
                self.lost += len(chunk)
                return
            if isinstance(chunk, FrameChunk):  # numbered in their order
                chunk.number[:] += self._number
                self._number += len(chunk)
            if self.kind is not None and len(chunk):
                self._note_order(chunk.times)
            self._parts.append((now, chunk))
            self._bytes += size

    def _note_order(self, times: I64) -> None:
        first = int(times[0]) if self._newest is None else self._newest
        newest = np.maximum.accumulate(np.maximum(times, first))
        behind = int((newest - times).max())
        self._newest = int(newest[-1])
        self._unordered |= behind > 0
        self._fell |= behind >= LATE_NS

    def read(self) -> Chunk:
        """Return rows since the last call, in order of time.

        Numbers wait for `LATE_NS`. Those of a clock that fell back stay as they were pushed: its
        fit refuses them. Events and frames that are late are left out, and counted.
        """
        parts: list[Chunk] = []
        size = 0
        with self._lock:
            ripe = time.monotonic_ns()
            if self.kind is not None and self._running and not self._fell:
                ripe -= LATE_NS
            while self._parts and size < READ_BYTES and self._parts[0][0] <= ripe:
                parts.append(self._parts.popleft()[1])
                size += _bytes(parts[-1])
            if parts and self._unordered and not self._fell:
                parts += self._older(max(int(part.times.max(initial=-MOST_NS)) for part in parts))
                size = sum(map(_bytes, parts))
            self._bytes -= size
        chunk = type(parts[0]).concatenate(parts) if parts else self.empty()
        if self._fell or not len(chunk):
            return chunk
        if np.any(chunk.times[1:] < chunk.times[:-1]):
            chunk = chunk[np.argsort(chunk.times, kind="stable")]
        if self.kind is None and self._last is not None and chunk.times[0] < self._last:
            good = chunk.times >= self._last
            self.late += int((~good).sum())
            chunk = chunk[good]
        if len(chunk):
            self._last = int(chunk.times[-1])
        return chunk

    def _older(self, newest: int) -> list[Chunk]:
        """Remove and return the rows that wait and are older than a time."""
        found: list[Chunk] = []
        left: deque[tuple[int, Chunk]] = deque()
        for at, part in self._parts:
            old = part.times < newest
            if old.any():
                found.append(part[old])
                part = part[~old]
            if len(part):
                left.append((at, part))
        self._parts = left
        return found

    @property
    def waiting(self) -> bool:
        """Whether rows wait to be read."""
        return bool(self._parts)

    def read_pulses(self) -> Chunk:
        """Return no pulse: none is wired to a program."""
        from sliplab.storage.streams import PulseChunk

        return PulseChunk.empty()

    def _chunk(self, now: int, t: Any, values: tuple[Any, ...], named: Mapping[str, Any]) -> Chunk:
        per_unit = 1000 if self._camera == EVENTS_KIND else 1
        times = np.atleast_1d(np.asarray(now // per_unit if t is None else t))
        if times.dtype.kind not in "iu" or times.ndim != 1:
            raise InputError(self._name, "t", t, "must be whole numbers: ns, or us of events")
        if any(
            abs(int(each)) * per_unit >= MOST_NS
            for each in (times.min(initial=0), times.max(initial=0))
        ):
            text = "must lie within 146 years of its clock's zero"
            raise InputError(self._name, "t", int(times[np.argmax(np.abs(times))]), text)
        times = times.astype(np.int64)
        if self._host_clock and len(times) and abs(int(times[-1]) * per_unit - now) > _DAY_NS:
            text = 'is not of time.monotonic_ns(); declare the stream with clock="own"'
            if abs(int(times[-1]) - now) <= _DAY_NS:
                text = "is in ns; times of events are in us: give time.monotonic_ns() // 1000"
            raise InputError(self._name, "t", int(times[-1]), text)
        expected = self.columns or (("x", "y", "p") if per_unit > 1 else ("images",))
        given = dict(zip(expected, values, strict=False)) | dict(named)
        if len(values) > len(expected) or set(given) != set(expected):
            found = [*given, *map(str, values[len(expected) :])]
            raise InputError(self._name, "", found, f"must be the columns {', '.join(expected)}")
        if self._camera == FRAMES_KIND:
            return self._frames(times, now, np.asarray(given["images"]))
        arrays = {name: self._numbers(name, value) for name, value in given.items()}
        if wrong := [name for name, each in arrays.items() if each.shape != times.shape]:
            text = f"must have one number for each of {len(times)} times"
            raise InputError(self._name, wrong[0], arrays[wrong[0]].shape, text)
        if self._camera == EVENTS_KIND:
            return self._events(times, arrays)
        assert self.kind is not None
        host = np.full(len(times), now)
        names = ("value",) if self.kind == SCALAR else self.columns
        by_name = dict(zip(names, (arrays[name] for name in self.columns), strict=True))
        return rows(self.kind, self.unit, {"t": times, "host": host, **by_name})

    def _numbers(self, name: str, value: Any) -> Any:
        """Return values of a column as an array of its own: the program may use theirs again."""
        try:
            found = np.atleast_1d(np.array(value))
        except ValueError:  # lists of different lengths
            found = np.empty(0, object)
        if found.dtype.kind not in "iuf":
            raise InputError(self._name, name, value, "must be a number, or numbers")
        if found.dtype.itemsize > 8:  # long double
            found = found.astype(np.float64)
        if (
            found.dtype.kind in "iu"
            and found.size
            and max(-int(found.min()), int(found.max())) > _WHOLE
        ):
            text = "cannot be stored: float64 holds whole numbers up to 2**53; push it in two parts"
            raise InputError(self._name, name, int(found[np.argmax(np.abs(found))]), text)
        whole = np.isfinite(found) & (found == np.floor(found))
        if self._camera == EVENTS_KIND and not whole.all():
            raise InputError(self._name, name, value, "must be whole numbers")
        return found

    def _events(self, times: Any, arrays: Mapping[str, Any]) -> EventChunk:
        assert self._size is not None
        for name, most in zip("xyp", (*self._size, 2), strict=True):
            found = arrays[name]
            if len(found) and not 0 <= int(found.min()) <= int(found.max()) < most:
                text = f"must be from 0 to {most - 1}"
                raise InputError(self._name, name, int(found.max()), text)
        x, y, p = (arrays[name] for name in "xyp")
        return EventChunk(x.astype(np.uint16), y.astype(np.uint16), p.astype(np.uint8), times)

    def _frames(self, times: Any, now: int, images: Any) -> FrameChunk:
        assert self._size is not None
        images = images[None] if images.ndim == 2 else images
        n, (width, height) = len(times), self._size
        if images.shape != (n, height, width) or images.dtype != np.uint8:
            text = f"must be uint8 of shape ({n}, {height}, {width})"
            raise InputError(self._name, "images", f"{images.dtype} {images.shape}", text)
        number, host = np.arange(n, dtype=np.int64), np.full(n, now)
        return FrameChunk(images.copy(), number, times, host, np.zeros(n, np.uint8))


def _bytes(chunk: Chunk) -> int:
    return sum(array.nbytes for array in chunk._arrays().values())
