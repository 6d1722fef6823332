"""Events of a file that lists them in another order than that of their times, sorted in parts.

Events go to temporary files, each for a range of times, and back to memory file by file: a
recording of any size needs the memory of one of them.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np

from sliplab.storage.files import scratch_folder
from sliplab.storage.formats.foreign import ForeignChunk, left_out_of
from sliplab.storage.formats.time_order import in_order
from sliplab.storage.streams import I64, EventChunk

_ROW = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
_PART, _MOST_PARTS = 1 << 20, 256
"""Events of a temporary file, and files; of more events each holds more."""
_SAMPLED = 64
"""One of so many times decides where files begin."""
_BLOCK = 1 << 21
"""Events of which the share in order is counted together."""
_NEAR_US, _FEW_FALLS, _MIXED_SHARE = 100_000, 10, 0.9
"""Step back up to which packets overlap; steps back, and share of the rows in order, up to which
they are faults."""


def by_time(read: Callable[[], Iterator[EventChunk]]) -> Iterator[EventChunk]:
    """Yield events in order of time if their file lists them otherwise, else as the file does.

    A file lists them otherwise where those of each polarity are in order, where times step back by
    no more than 0.1 s, or in many places, such as in lists by pixel. A few larger steps back are
    faults, which stay.

    Args:
        read: yields the events as the file lists them; called twice.
    """
    order = _Order()
    for chunk in read():
        order.add(chunk)
    return _sorted(read, order.bounds()) if order.is_another() else read()


class _Order:
    """Order in which a file lists its events, chunk by chunk."""

    def __init__(self) -> None:
        self._previous: int | None = None
        self._latest: dict[str, I64] = {}
        self._events = self._falls = self._most_back_us = self._in_order = 0
        self._mixed = False
        self._block = np.empty(0, np.int64)
        self._sample: list[I64] = []

    def add(self, chunk: EventChunk) -> None:
        """Add the next events."""
        t_us = chunk.t_us
        if not len(t_us):
            return
        before = t_us[0] if self._previous is None else self._previous
        self._falls += int((np.diff(t_us, prepend=before) < 0).sum())
        self._previous = int(t_us[-1])
        self._most_back_us = max(self._most_back_us, self._back_us("all", t_us))
        for polarity, rows in (("on", chunk.p > 0), ("off", chunk.p == 0)):
            self._mixed |= self._back_us(polarity, t_us[rows]) > 0
        self._events += len(t_us)
        self._sample.append(t_us[::_SAMPLED].copy())
        self._block = np.append(self._block, t_us)
        if len(self._block) >= _BLOCK:
            self._end_block()

    def _back_us(self, part: str, t_us: I64) -> int:
        """Return the largest step back from the latest time of a part of the events so far, us."""
        latest = np.maximum.accumulate(np.append(self._latest.get(part, t_us[:1]), t_us))
        self._latest[part] = latest[-1:].copy()
        return int((latest[-len(t_us) :] - t_us).max(initial=0)) if len(t_us) else 0

    def _end_block(self) -> None:
        self._in_order += int(in_order(self._block).sum())
        self._block = self._block[:0]

    def is_another(self) -> bool:
        """Return whether it is another order than that of the times."""
        if not self._falls:
            return False
        if not self._mixed or self._most_back_us <= _NEAR_US:
            return True
        self._end_block()
        return self._falls > _FEW_FALLS and self._in_order < _MIXED_SHARE * self._events

    def bounds(self) -> I64:
        """Return times that divide the events into parts of about `_PART`."""
        parts = min(-(-self._events // _PART), _MOST_PARTS)
        if parts < 2:
            return np.empty(0, np.int64)
        times = np.sort(np.concatenate(self._sample))
        return times[np.arange(1, parts) * len(times) // parts]


def _sorted(read: Callable[[], Iterator[EventChunk]], bounds: I64) -> Iterator[EventChunk]:
    """Yield all events in order of time; those of one time in the order of the file."""
    left_out, resolution = Counter[str](), 0.0
    with scratch_folder() as folder:
        parts = [folder / str(number) for number in range(len(bounds) + 1)]
        for chunk in read():
            left_out.update(left_out_of(chunk))
            if isinstance(chunk, ForeignChunk):
                resolution = max(resolution, chunk.resolution_us)
            _divide(chunk, bounds, parts)
        for part in filter(Path.exists, parts):
            rows = np.fromfile(part, _ROW)
            rows = rows[np.argsort(rows["t"], kind="stable")]
            x, y, p, t_us = (np.ascontiguousarray(rows[key]) for key in "xypt")
            yield ForeignChunk(x, y, p, t_us, left_out, resolution)
            left_out = Counter()


def _divide(chunk: EventChunk, bounds: I64, parts: list[Path]) -> None:
    """Append events to the files of their times."""
    rows = np.empty(len(chunk), _ROW)
    for key, values in {"t": chunk.t_us, "x": chunk.x, "y": chunk.y, "p": chunk.p}.items():
        rows[key] = values
    of = np.searchsorted(bounds, chunk.t_us, "right")
    rows = rows[np.argsort(of, kind="stable")]
    ends = np.searchsorted(np.sort(of), np.arange(len(parts) + 1))
    for part, (low, high) in zip(parts, pairwise(ends.tolist()), strict=True):
        if high > low:
            with part.open("ab") as file:
                rows[low:high].tofile(file)
