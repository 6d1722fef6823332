"""Change-point estimate of a papilla's slip onset from its track, with a 95 % interval.

The paper's rule dates a slip by the frame in which a marker has gone 2 pixels, which at 0.6 mm/s is
a sixth of a second after it let go. Here the whole track about that moment is used. Before the slip
the marker rests (a slow drift is allowed for); from then on it moves at an unknown velocity that
wanders: stick-slip, friction that varies along the path. A stuck papilla holds more than a sliding
one, so that it starts with a jerk, which dies away. So the way after the slip is a straight line,
an exponential that saturates, and an integrated Wiener process: the frames nearest to the slip
count most, and what a later frame says is discounted by how much the velocity may have changed
until then.

Time of the slip, strength of the wandering, length of the jerk and everything linear are inferred
together: the linear part is integrated out in closed form with flat priors, the rest on a grid. The
estimate is the median of the slip time's posterior, the interval its central 95 %. A place is the
mean over the exposure, so that a frame in which the slip begins lies on a parabola.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sliplab.storage.kernels import njit

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

BEFORE, AFTER = 12, 8
"""Frames before and after the slip that are used."""
DEPARTED_PX = 0.06
DEPARTED_SIGMAS = 6.0
"""A marker has left its place when three frames in a row are this far from where it was."""
_REST = (24, 4)
"""Frames before the present one over which the median gives its place: first and last."""
_WANDER = 2.0 ** np.arange(-6.0, 0.0)
"""Strength of the wandering as shares of the speed, a frame to the power -1/2."""
_RELIEF = np.array([0.12, 0.25, 0.5, 1.0, 2.0, 4.0])
"""Relaxation time of the excess of static friction, frames."""
_DRIFT_PX = 0.002
"""Prior of the drift before the slip, px a frame, standard deviation."""
_RIDGE = 1e-9
"""Added to the squares of what is integrated out."""
_COARSE, _FINE = 49, 61


@dataclass(frozen=True)
class ChangePoint:
    """One slip's beginning.

    Attributes:
        at_ns: median; low_ns, high_ns: the central 95 %. On the frames' time line.
    """

    at_ns: int
    low_ns: int
    high_ns: int


def departure(away: Floats, sigma: Floats, first: int) -> int | None:
    """Index of the first frame from which a marker has left its place for good.

    Args:
        away: (n, 2) displacement, px, NaN where unknown. sigma: (n,) px.
        first: frames before this one are at rest.
    """
    seen = np.flatnonzero(np.isfinite(away).all(axis=1) & np.isfinite(sigma))
    if len(seen) < 6:
        return None
    places, limit = away[seen], np.maximum(DEPARTED_PX, DEPARTED_SIGMAS * sigma[seen])
    # far off rest positions first: what never gets that far cannot have left
    for k in range(int(np.searchsorted(seen, first)), len(seen) - 2):
        step = places[k] - places[max(k - 3, 0)]
        if abs(step[0]) + abs(step[1]) <= 0.5 * limit[k]:
            continue
        rest = np.median(places[max(k - _REST[0], 0) : max(k - _REST[1], 1)], axis=0)
        off = np.hypot(*(places[k : k + 3] - rest).T)
        if (off > limit[k : k + 3]).all():
            return int(seen[k])
    return None


def change_point(
    frame_ns: Ints, away: Floats, sigma: Floats, departed: int, exposure_ns: int
) -> ChangePoint | None:
    """Locate the onset of the slip that `departure` found.

    Args:
        frame_ns: (n,) int64. away: (n, 2) px. sigma: (n,) px.
        departed: a frame in which the marker had left its place for sure.
        exposure_ns: how long the shutter is open.

    Returns:
        None where too little is known about that moment.
    """
    low, high = max(departed - BEFORE, 0), min(departed + AFTER, len(frame_ns))
    near = np.arange(low, high)
    near = near[np.isfinite(away[near]).all(axis=1) & np.isfinite(sigma[near])]
    before, after = near[near < departed - 1], near[near >= departed]
    if len(before) < 3 or len(after) < 3:
        return None
    period_ns = float(np.median(np.diff(frame_ns)))
    t = (frame_ns[near] - frame_ns[departed]) / period_ns
    way = away[after[-1]] - np.median(away[before], axis=0)
    length = float(np.hypot(*way))
    if length == 0.0:
        return None
    along = away[near] @ (way / length)
    speed = length / max(float(frame_ns[after[-1]] - frame_ns[departed]) / period_ns, 1.0)
    last_rest = float((frame_ns[before[-1]] - frame_ns[departed]) / period_ns)
    half = 0.5 * exposure_ns / period_ns
    span = (min(last_rest, -1.0) - 4.0, 2.0)
    times = np.linspace(*span, _COARSE)
    weight = _posterior(times, t, along, sigma[near], speed, half)
    # again where it is not nothing
    there = np.flatnonzero(weight > 1e-6 * weight.max())
    step = times[1] - times[0]
    times = np.linspace(times[there[0]] - step, times[there[-1]] + step, _FINE)
    weight = _posterior(times, t, along, sigma[near], speed, half)
    share = np.concatenate(([0.0], np.cumsum((weight[1:] + weight[:-1]) / 2)))
    at = np.interp(np.array([0.025, 0.5, 0.975]) * share[-1], share, times)
    lower, middle, upper = (int(frame_ns[departed]) + round(v * period_ns) for v in at.tolist())
    return ChangePoint(middle, lower, upper)


def _posterior(
    times: Floats, t: Floats, along: Floats, sigma: Floats, speed: float, half: float
) -> Floats:
    """Weight of each time of the slip, (k,), all else summed out."""
    logs = _log_evidence(times, t, along, sigma, speed * _WANDER, _RELIEF, half)
    result: Floats = np.exp(logs - logs.max()).sum(axis=(1, 2))
    return result


@njit(cache=True, nogil=True)
def _design(u: Any, along: Any, relief: Any, half: float, table: Any) -> None:
    """Fill (n, 3 + r): rest, way at speed 1, r reliefs of length 1, and what was measured."""
    for i in range(u.size):
        way = max(u[i], 0.0)
        if abs(u[i]) < half:
            # the mean over an exposure in which it begins
            way = (u[i] + half) ** 2 / (4.0 * half)
        table[i, 0], table[i, 1] = 1.0, way
        for k in range(relief.size):
            table[i, 2 + k] = 1.0 - np.exp(-way / relief[k])
        table[i, 2 + relief.size] = along[i]


@njit(cache=True, nogil=True)
def _whiten(u: Any, sigma: Any, strength: float, drift: float, root: Any, table: Any) -> float:
    """Solve by the covariance's Cholesky root in place; the logarithm of its determinant's root.

    Covariance: noise, a drift before the slip, and an integrated Wiener process after it.
    """
    n, spread = u.size, 0.0
    for i in range(n):
        for j in range(i + 1):
            if u[i] > 0.0 and u[j] > 0.0:
                low, high = min(u[i], u[j]), max(u[i], u[j])
                value = strength * strength * low * low * (3.0 * high - low) / 6.0
            elif u[i] < 0.0 and u[j] < 0.0:
                value = u[i] * u[j] * drift * drift
            else:
                value = 0.0
            if i == j:
                value += sigma[i] * sigma[i]
            for k in range(j):
                value -= root[i, k] * root[j, k]
            root[i, j] = np.sqrt(value) if i == j else value / root[j, j]
        spread += np.log(root[i, i])
        for c in range(table.shape[1]):
            value = table[i, c]
            for k in range(i):
                value -= root[i, k] * table[k, c]
            table[i, c] = value / root[i, i]
    return spread


@njit(cache=True, nogil=True)
def _log_positive(z: float) -> float:
    """Logarithm of the normal distribution function."""
    if z > -30.0:
        return np.log(0.5 * math.erfc(-z / math.sqrt(2.0)))
    return -0.5 * z * z - np.log(-z * math.sqrt(2.0 * math.pi))


@njit(cache=True, nogil=True)
def _evidence(table: Any, k: int) -> float:
    """Of whitened columns, relief k: place, speed and relief integrated out with flat priors.

    Speed and relief go forwards: what of them lies below zero is left out, one by one.
    """
    last = table.shape[1] - 1
    normal, right = np.zeros((3, 3)), np.zeros(3)
    squares = 0.0
    for i in range(table.shape[0]):
        row = (table[i, 0], table[i, 1], table[i, 2 + k])
        y = table[i, last]
        squares += y * y
        for a in range(3):
            right[a] += row[a] * y
            for b in range(a + 1):
                normal[a, b] += row[a] * row[b]
    # Where a column is nothing yet (no frame after the slip) it is not determined: a ridge. No
    # square of Cholesky's root falls below it, but by rounding. The root is written out, since a
    # library's call takes ten times as long for three unknowns.
    r00 = np.sqrt(normal[0, 0] + _RIDGE)
    r10, r20 = normal[1, 0] / r00, normal[2, 0] / r00
    r11 = np.sqrt(max(normal[1, 1] - r10 * r10, 0.0) + _RIDGE)
    r21 = (normal[2, 1] - r20 * r10) / r11
    r22 = np.sqrt(max(normal[2, 2] - r20 * r20 - r21 * r21, 0.0) + _RIDGE)
    w0 = right[0] / r00
    w1 = (right[1] - r10 * w0) / r11
    w2 = (right[2] - r20 * w0 - r21 * w1) / r22
    result = -0.5 * (squares - w0 * w0 - w1 * w1 - w2 * w2) - np.log(r00 * r11 * r22)
    # speed and relief over their standard deviations
    bent = r21 / r22
    return result + _log_positive((w1 - bent * w2) / np.hypot(1.0, bent)) + _log_positive(w2)


@njit(cache=True, nogil=True)
def _log_evidence(
    times: Any, t: Any, along: Any, sigma: Any, strengths: Any, relief: Any, half: float
) -> Any:
    """(times, strengths, reliefs)."""
    result = np.empty((times.size, strengths.size, relief.size))
    root = np.zeros((t.size, t.size))
    plain = np.empty((t.size, 3 + relief.size))
    for a in range(times.size):
        u = t - times[a]
        _design(u, along, relief, half, plain)
        for b in range(strengths.size):
            table = plain.copy()
            spread = _whiten(u, sigma, strengths[b], _DRIFT_PX, root, table)
            for k in range(relief.size):
                result[a, b, k] = _evidence(table, k) - spread
    return result
