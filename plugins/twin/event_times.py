"""Estimates of a scanning read-out and of a pixel's dead time from the times of events.

A read-out that scans gives all events of a column times that differ by whole periods, and those of
other columns the same times later by what a scan takes to get there. A pixel that is dead for a
while has no two events nearer to each other; what a scan adds to the interval of two events is
triangular, between less a period and one more.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64, EventChunk

SCANS_HZ = (900.0, 11_000.0)
"""Frequencies of scans that are looked for."""
COHERENT = 0.8
"""A frequency is that of scans where intervals agree with it so well: 1 for exact ones."""
LONGEST_US = 5_000
"""Intervals between two events of a column that a first search looks at; a hundred times as long
ones refine it."""
INTERVALS_US = 20_000
"""Intervals between two events of a pixel are counted up to here."""
_PAIRS = 1_500
_FEWEST = 50
_LEADS = 64


@dataclass(frozen=True)
class ScanningReadout:
    """A read-out that scans.

    Attributes:
        period_us: from one scan to the next. scan_us: from its first column to its last one, and
            one more.
    """

    period_us: float
    scan_us: float


def find_scans(events: EventChunk, width: int) -> ScanningReadout | None:
    """Find the scans of a read-out; None where times do not show any.

    Args:
        events: sorted by time. width: columns of the camera.
    """
    order = np.argsort(events.x, kind="stable")
    column, t_us = events.x[order], events.t_us[order]
    near = _same_column(column, t_us, 1, LONGEST_US)
    if len(near) < _FEWEST:
        return None
    # an interval of n us has a peak 1 / n wide
    trials = np.arange(SCANS_HZ[0], SCANS_HZ[1], 1e6 / LONGEST_US / 8.0) * 1e-6
    found = _agreement(near, trials)
    # multiples of a frequency agree as well as it does
    good = np.flatnonzero(found > COHERENT * max(found.max(), COHERENT))
    if not len(good):
        return None
    peak = good[0] + int(found[good[0] : good[0] + 8].argmax())
    frequency, width_hz = float(trials[peak]), 1.0 / LONGEST_US / 4.0
    for factor in (10, 100):
        lag = 1
        far = near
        while lag < 512 and (not len(far) or np.median(far) < factor * LONGEST_US / 8):
            lag *= 2
            pairs = _same_column(column, t_us, lag, factor * LONGEST_US)
            if len(pairs) < _FEWEST:
                break
            far = pairs
        trials = frequency + np.linspace(-width_hz, width_hz, 81)
        found = _agreement(far, trials)
        frequency = _top(trials, found)
        width_hz /= 10.0
    if _agreement(near, np.array([frequency]))[0] < COHERENT:
        return None
    period = 1.0 / frequency
    return ScanningReadout(period, _scan_us(events, width, period))


def _scan_us(events: EventChunk, width: int, period: float) -> float:
    """Time that a scan takes, by events of different columns that follow each other."""
    t_us, x = _thinned(events.t_us, events.x)
    lag_us, columns = np.diff(t_us), np.diff(x.astype(np.int64))
    near = (lag_us < LONGEST_US) & (columns != 0)
    lag_us, columns = lag_us[near].astype(np.float64), columns[near].astype(np.float64)
    if len(lag_us) < _FEWEST:
        return np.nan
    low, high = 0.0, period / width
    for _ in range(3):
        leads = np.linspace(low, high, _LEADS)
        phase = (lag_us[:, None] - columns[:, None] * leads) / period
        found = np.cos(2.0 * np.pi * phase).mean(axis=0)
        best, step = _top(leads, found), leads[1] - leads[0]
        # a scan as long as the period is like one of no length: both ends may be right
        low, high = max(best - 2.0 * step, 0.0), best + 2.0 * step
    return best * width


def _same_column(column: Any, t_us: I64, lag: int, longest_us: int) -> F64:
    """Intervals between an event and the one `lag` later of its column, us, some of them."""
    if len(t_us) <= lag:
        return np.empty(0)
    apart = t_us[lag:] - t_us[:-lag]
    # one us is what rounding makes of two events of one scan
    retained = (column[lag:] == column[:-lag]) & (apart > 1) & (apart < longest_us)
    return apart[retained][:: max(int(retained.sum()) // _PAIRS, 1)].astype(np.float64)


def _thinned(t_us: I64, x: Any) -> tuple[I64, Any]:
    """Runs of successive events, some thousands of all."""
    if len(t_us) <= 4 * _PAIRS:
        return t_us, x
    first = np.linspace(0, len(t_us) - 100, 4 * _PAIRS // 100).astype(np.int64)
    index = np.unique((first[:, None] + np.arange(100)).ravel())
    return t_us[index], x[index]


def _agreement(intervals_us: F64, per_us: F64) -> F64:
    """Return how well intervals match whole multiples of periods, -1 to 1, by frequency."""
    result: F64 = np.cos(2.0 * np.pi * np.outer(per_us, intervals_us)).mean(axis=1)
    return result


def _top(x: F64, y: F64) -> float:
    """Return the position of y's maximum, by a parabola through the highest three points."""
    k = int(np.clip(y.argmax(), 1, len(x) - 2))
    bend = y[k - 1] - 2.0 * y[k] + y[k + 1]
    shift = 0.5 * (y[k - 1] - y[k + 1]) / bend if bend < 0.0 else 0.0
    return float(x[k] + np.clip(shift, -1.0, 1.0) * (x[k + 1] - x[k]))


@njit(cache=True, nogil=True)
def count_intervals(t_us: Any, x: Any, y: Any, chosen: Any, last_us: Any, counts: Any) -> None:
    """Count intervals between two events of a pixel, one by one of us.

    Args:
        chosen: (height, width) bool, pixels to look at.
        last_us: scratch, (height, width), overwritten.
        counts: (n,), added to: intervals of 0 to n - 1 us.
    """
    last_us[:] = -(1 << 62)
    for k in range(t_us.size):
        row, column = y[k], x[k]
        if chosen[row, column]:
            apart = t_us[k] - last_us[row, column]
            if apart < counts.size:
                counts[apart] += 1
            last_us[row, column] = t_us[k]


def dead_time_us(counts: I64, rate_hz: float, period_us: float | None) -> float:
    """Estimate the refractory period from the intervals of noise pixels; NaN with too few.

    Beyond the dead time intervals are exponential. The likelihood is that of Poisson counts of
    whole periods.

    Args:
        counts: of intervals by us, as `count_intervals` makes them.
        rate_hz: at which such a pixel fires when it is not dead.
        period_us: of a read-out that scans; None where each event has its own time.
    """
    total = int(counts.sum())
    if total < _FEWEST:
        return np.nan
    if period_us is None:
        first = int(np.flatnonzero(counts)[0])
        # the first of so many intervals is later than the dead time by a mean gap between them
        return max(first + 0.5 - (len(counts) - first) / total, 0.0)
    n = int(len(counts) / period_us) - 1
    periods = np.rint(np.arange(len(counts)) / period_us).astype(np.int64)
    seen = np.bincount(periods, weights=counts, minlength=n + 1)[: n + 1]
    k = np.arange(n + 1)
    decay = np.exp(-rate_hz * 1e-6 * period_us * k)

    def cost(dead_us: float) -> float:
        # share of a triangle about k periods, a period wide either way, beyond the dead time
        u = np.clip(dead_us / period_us - k, -1.0, 1.0)
        share = np.where(u < 0.0, 1.0 - 0.5 * (1.0 + u) ** 2, 0.5 * (1.0 - u) ** 2)
        share[0] = 0.0  # two events of a scan are one
        share = np.maximum(share * decay, 1e-4)
        expected = share * seen.sum() / share.sum()
        return float((expected - seen * np.log(expected)).sum())

    trials = np.linspace(0.0, 0.5 * n * period_us, 4 * n)
    best = int(np.argmin([cost(dead_us) for dead_us in trials]))
    step = trials[1] - trials[0]
    found = minimize_scalar(
        cost, bounds=(max(trials[best] - step, 0.0), trials[best] + step), method="bounded"
    )
    return float(found.x)
