"""Device counters as times: wrapped counters made whole, and restarts found.

Cameras count in 32 bits: microseconds wrap after 71 minutes, 8 ns ticks after 34 seconds. A counter
that falls back has wrapped or its device has restarted; the two are distinguished by how long the
step would have taken. After a restart nothing that was known of a clock holds, so a trial is split
there and each part is fitted by itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Unwrapped:
    """A counter as times.

    Attributes:
        ns: (n,) int64 times on the device's clock; after a restart they begin anew.
        starts: (k,) index of the first stamp of each stretch between restarts; 0 is the first.
        wraps: how often the counter wrapped.
    """

    ns: Ints
    starts: Ints
    wraps: int

    @property
    def stretches(self) -> list[slice]:
        """The stretches between restarts, in order; at least one unless there are no stamps."""
        edges = [*self.starts.tolist(), self.ns.size]
        return [slice(a, b) for a, b in pairwise(edges)]


def unwrap(
    counts: NDArray[np.integer[Any]],
    bits: int,
    tick_ns: int,
    max_gap_ns: int,
    host_ns: Ints | None = None,
    host_error_ns: int = 100_000_000,
) -> Unwrapped:
    """Times of a counter's stamps that came in order.

    Without host times, a step forward (round the wrap, if need be) of more than `max_gap_ns` is
    taken for a restart. With host times whole turns in a gap are counted, and a restart is a step
    that does not agree with the host's, whole turns apart.

    Args:
        counts: (n,) unsigned stamps in the order in which they came, each below 2**bits.
        bits: width of the counter, 1 to 62.
        tick_ns: duration of a count, ns.
        max_gap_ns: the longest silence to be expected within a trial, ns; below a turn.
        host_ns: (n,) when each stamp arrived, host clock, ns.
        host_error_ns: by how much host intervals may be wrong; below a quarter turn.

    Raises:
        TypeError: counts are not integers.
        ValueError: a count does not fit the counter, or a limit does not fit a turn.
    """
    array = np.asarray(counts)
    if array.dtype.kind not in "iu":
        raise TypeError(f"counts must be integers, not {array.dtype}")
    if not 1 <= bits <= 62 or tick_ns < 1 or (1 << bits) * tick_ns >= 1 << 62:
        raise ValueError(f"bits = {bits} and tick_ns = {tick_ns}: a turn must be below 2**62 ns")
    turn = (1 << bits) * tick_ns
    if not 0 < max_gap_ns < turn:
        raise ValueError(f"max_gap_ns = {max_gap_ns}: must lie between 0 and a turn of {turn} ns")
    if array.size and (int(array.min()) < 0 or int(array.max()) >= 1 << bits):
        raise ValueError(f"counts must lie between 0 and 2**{bits} - 1")
    times = array.astype(np.int64) * tick_ns
    if times.size == 0:
        return Unwrapped(times, np.empty(0, np.int64), 0)
    steps = np.diff(times) % turn
    if host_ns is None:
        restarts = steps > max_gap_ns
    else:
        if not 0 < host_error_ns < turn // 4:
            raise ValueError(
                f"host_error_ns = {host_error_ns}: must be below a quarter turn of {turn // 4} ns"
            )
        host_steps = np.diff(np.asarray(host_ns, np.int64))
        turns = np.maximum((host_steps - steps + turn // 2) // turn, 0)
        steps = steps + turns * turn
        restarts = np.abs(steps - host_steps) > host_error_ns
    steps[restarts] = 0
    starts = np.concatenate([[0], np.flatnonzero(restarts) + 1]).astype(np.int64)
    whole = times[0] + np.concatenate([[0], np.cumsum(steps)])
    # each stretch counts from its own first stamp
    for start in starts[1:].tolist():
        whole[start:] += times[start] - whole[start]
    wraps = sum(
        int(whole[end - 1] // turn - whole[start] // turn)
        for start, end in pairwise([*starts.tolist(), whole.size])
    )
    return Unwrapped(whole, starts, wraps)


def split_at_restarts(times_ns: Ints, back_ns: int) -> list[slice]:
    """Stretches of whole times that came in order, cut where the clock falls back by `back_ns`."""
    cuts = np.flatnonzero(np.diff(times_ns) < -back_ns) + 1
    edges = [0, *cuts.tolist(), int(times_ns.size)]
    return [slice(a, b) for a, b in pairwise(edges) if b > a]
