"""Clock map from a host's bounds on a device's clock: not before, and not after.

Where no pulse reaches a device, the computer still knows bounds. A clock that is read is read
between the question and the answer; a message was sent before it arrived, and not longer before
than its way can take. Every such pair of bounds leaves a strip of lines that are possible; the map
is the middle of what all of them leave, and its uncertainty is not an estimate but half the width
of that strip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from sliplab.storage.clockmap import ClockMap

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MIN_PAIRS = 3
MOST_YEARS = 100
PIECE = 64
"""Messages in a piece; between two jumps of a clock there is at least one whole piece."""
MOST_ROWS = 4000
"""Messages that bound a straight line as well as all of them do."""


class BoundsContradictError(ValueError):
    """No straight clock lies between the bounds: it jumped, or a bound is wrong."""


@dataclass(frozen=True)
class BoundedClock:
    """A clock map with hard bounds.

    Attributes:
        map: device ns to reference ns, the middle of all lines that are possible.
        uncertainty_ns: the map is off by no more between the first and the last pair, ns.
        drift_ppm, drift_error_ppm: middle and half of the range of drifts that is possible.
        pairs: how many pairs of bounds there were.
        tightest_ns: width of the narrowest of them.
        widest_ns: width of the widest.
        slowest_ns: delay of the slowest message, more than that of the fastest.
    """

    map: ClockMap
    uncertainty_ns: float
    drift_ppm: float
    drift_error_ppm: float
    pairs: int
    tightest_ns: int
    widest_ns: int
    slowest_ns: int


def fit_bounds(
    device_ns: Ints,
    not_before_ns: Ints,
    not_after_ns: Ints,
    max_drift_ppm: float,
) -> BoundedClock:
    """The clock map that lies between bounds.

    A jump that is smaller than the distance of the bounds cannot be seen. The uncertainty of
    readings holds for a clock that does not jump.

    Args:
        device_ns: (n,) int64 times on the device's clock.
        not_before_ns, not_after_ns: (n,) int64 bounds of the same instants, reference clock.
        max_drift_ppm: by how much the clocks may differ; with few pairs it is what bounds the map.

    Raises:
        BoundsContradictError: no line with an allowed drift keeps all bounds.
        ValueError: too few pairs, or lengths that differ.
    """
    device, low, high = (np.asarray(a, np.int64) for a in (device_ns, not_before_ns, not_after_ns))
    if not device.shape == low.shape == high.shape or device.ndim != 1:
        raise ValueError("device_ns, not_before_ns and not_after_ns must be 1-D and equally long")
    if device.size < MIN_PAIRS:
        raise ValueError(f"{device.size} pairs of bounds; at least {MIN_PAIRS} are needed")
    if (low > high).any():
        raise BoundsContradictError(
            f"{int((low > high).sum())} of {device.size} instants have an earliest time after "
            f"their latest, by {int((low - high).max()) / 1e3:g} us at most; none may: "
            "check the stated delays, and that nothing sets the host's clock"
        )
    if (years := (int(device.max()) - int(device.min())) / 3.15576e16) > MOST_YEARS:
        raise BoundsContradictError(
            f"its times lie {years:.0f} years apart: are they of one clock?"
        )
    origin, image = int(device.min()), int(low[0])
    widest, slowest = int((high - low).max()), int(np.ptp(high - device))
    x = (device - origin).astype(np.float64) * 1e-9
    least = (low - image - (device - origin)).astype(np.float64) * 1e-3
    most = (high - image - (device - origin)).astype(np.float64) * 1e-3
    # the line is level + slope x: us over s, that is ppm
    run = max(float(x.max()), 1e-3)
    kept_low, kept_high = _upper_hull(x, least), _upper_hull(x, -most)
    rows = np.concatenate(
        [
            -np.stack([np.ones(kept_low.size), x[kept_low]], axis=1),
            np.stack([np.ones(kept_high.size), x[kept_high]], axis=1),
        ]
    )
    limits = np.concatenate([-least[kept_low], most[kept_high]])
    drift = (-max_drift_ppm, max_drift_ppm)
    ranges = []
    for value in ((1.0, 0.0), (1.0, run), (0.0, 1.0)):
        ends = []
        for sign in (1.0, -1.0):
            found = optimize.linprog(
                sign * np.array(value), A_ub=rows, b_ub=limits, bounds=((None, None), drift)
            )
            if found.status != 0:
                raise BoundsContradictError(
                    f"no clock that drifts by at most {max_drift_ppm:g} ppm lies between the "
                    f"bounds of all {device.size} instants; the best one misses some by "
                    f"{_missed_us(rows, limits, drift):.0f} us: it jumped or was set, its times "
                    "are of another clock, or a message took longer than is stated. Let nothing "
                    "set a clock, or raise drift_ppm or the longest delay"
                )
            ends.append(sign * float(found.fun))
        ranges.append((0.5 * (ends[0] + ends[1]), 0.5 * (ends[1] - ends[0])))
    (at_begin, spread_begin), (at_end, spread_end), (drift_ppm, spread_drift) = ranges
    slope = (at_end - at_begin) / run
    return BoundedClock(
        map=ClockMap((origin,), (image + round(at_begin * 1e3),), (round(slope * 1e12),)),
        uncertainty_ns=1e3 * max(spread_begin, spread_end) + 1.0,
        drift_ppm=drift_ppm,
        drift_error_ppm=spread_drift,
        pairs=int(device.size),
        tightest_ns=int((high - low).min()),
        widest_ns=widest,
        slowest_ns=slowest,
    )


def fit_messages(
    device_ns: Ints, not_before_ns: Ints, not_after_ns: Ints, max_drift_ppm: float
) -> BoundedClock:
    """The clock map between bounds of messages, of which there are many.

    As `fit_bounds`, with an uncertainty that holds also where the device's clock jumps unseen: by
    less than the delays of messages vary, with at least 2 `PIECE` messages before, after and
    between jumps. Within such a run the clock is straight, and one whole piece bounds it.
    """
    device, low, high = (np.asarray(a, np.int64) for a in (device_ns, not_before_ns, not_after_ns))
    some = slice(None, None, max(1, device.size // MOST_ROWS))
    found = fit_bounds(device[some], low[some], high[some], max_drift_ppm)
    mapped = np.asarray(found.map.to_reference(device))
    starts = np.arange(0, max(1, device.size // PIECE) * PIECE, PIECE)
    lengths = np.diff(device[starts], append=device[-1])
    spread = 4e-6 * max_drift_ppm * lengths + np.maximum(
        np.minimum.reduceat(high - mapped, starts), -np.maximum.reduceat(low - mapped, starts)
    )
    return replace(found, uncertainty_ns=max(found.uncertainty_ns, float(spread.max())))


def _missed_us(rows: Floats, limits: Floats, drift: tuple[float, float]) -> float:
    """Return by how much every line with an allowed drift misses a bound, us."""
    wider = np.column_stack([rows, -np.ones(len(rows))])
    found = optimize.linprog(
        (0.0, 0.0, 1.0), A_ub=wider, b_ub=limits, bounds=((None, None), drift, (0.0, None))
    )
    return float("nan") if found.status != 0 else float(found.fun)


def _upper_hull(x: Floats, y: Floats) -> Ints:
    """Indices of the points on the upper convex hull: the only ones that bind a line from below."""
    order = np.lexsort((y, x))
    hull: list[int] = []
    for k in order.tolist():
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[k] - y[a]) < (y[b] - y[a]) * (x[k] - x[a]):
                break
            hull.pop()
        if hull and x[hull[-1]] == x[k]:
            hull.pop()
        hull.append(k)
    return np.array(hull, np.int64)
