"""Flicker on purpose: noise events all over the event camera's array, for a while."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sliplab.rigs.mock.fault_settings import EventBurst
from sliplab.rigs.mock.world import World
from sliplab.rigs.scene.randomness import generator
from sliplab.rigs.scene.readout import Scans

I64 = npt.NDArray[np.int64]
U16 = npt.NDArray[np.uint16]
U8 = npt.NDArray[np.uint8]
Events = tuple[I64, U16, U16, U8]
"""True times ns, columns, rows and polarities, (n,) each, in order of time."""

_BIN_NS = 1_000_000


class Bursts:
    """The events of `event_burst`: a Poisson process in time, even over pixels and polarities."""

    def __init__(self, world: World, width: int, height: int) -> None:
        self._world, self._width, self._height = world, width, height

    def into(self, events: Events, begin_ns: int, end_ns: int, scans: Scans) -> Events:
        """`events` of the time from `begin_ns` (left out) to `end_ns`, with the burst's among them.

        Args:
            scans: of the read-out; the burst's events carry the times of its columns, too.
        """
        if not self._world.faults.of(EventBurst):
            return events
        burst = self.between(begin_ns, end_ns, scans)
        return _merge([events, burst]) if len(burst[0]) else events

    def between(self, begin_ns: int, end_ns: int, scans: Scans) -> Events:
        """The burst's events alone; in whatever pieces they are asked for."""
        # a scan is handed over when its last column has been read
        begin_ns, end_ns = begin_ns - scans.reading_ns, end_ns - scans.reading_ns
        parts = [_none()]
        for index, (fault, first_ns, last_ns) in enumerate(self._world.faults.spans(EventBurst)):
            low, high = max(begin_ns - scans.period_ns, first_ns), min(end_ns, last_ns)
            mean = fault.million_per_s * 1e6 * _BIN_NS * 1e-9
            for number in range(low // _BIN_NS, high // _BIN_NS + 1 if high >= low else 0):
                t_ns, x, y, p = self._bin(index, number, mean)
                kept = (t_ns >= first_ns) & (t_ns < last_ns)
                if scans.period_ns:
                    t_ns = scans.begin(t_ns)
                kept &= (t_ns > begin_ns) & (t_ns <= end_ns)
                t_ns, x, y, p = t_ns[kept], x[kept], y[kept], p[kept]
                parts.append((scans.stamp(t_ns, x), x, y, p))
        return _merge(parts)

    def _bin(self, index: int, number: int, mean: float) -> Events:
        rng = generator(self._world.seed, "event burst", index, number)
        count = int(rng.poisson(mean))
        t_ns = number * _BIN_NS + rng.integers(0, _BIN_NS, count)
        return (
            t_ns,
            rng.integers(0, self._width, count).astype(np.uint16),
            rng.integers(0, self._height, count).astype(np.uint16),
            rng.integers(0, 2, count).astype(np.uint8),
        )


def _merge(parts: list[Events]) -> Events:
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    # inside a scan pixels are read by column, then by row
    order = np.lexsort((columns[3], columns[2], columns[1], columns[0]))
    t_ns, x, y, p = (column[order] for column in columns)
    return t_ns, x, y, p


def _none() -> Events:
    empty = np.empty(0, np.uint16)
    return np.empty(0, np.int64), empty, empty, np.empty(0, np.uint8)
