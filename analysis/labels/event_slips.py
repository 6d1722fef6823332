"""Slip of each papilla from its marker's track inside the sensor, and the sensor's own motion.

A papilla that sticks to the plate is left behind by the sensor: its marker moves in the inner
picture in proportion to the sensor's travel, by an unknown gain that changes slowly (bending,
relaxation). One that slips is dragged along, and its marker stays where it is. So the beginning of
a slip is a knee in the marker's displacement over the sensor's travel, and what the displacement
lacks from then on, by the gain at the knee, is the distance slid.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import savgol_filter

from sliplab.storage.kernels import njit

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BEFORE_MM = 0.5
"""Travel before a knee over which the gain is fitted, by a parabola if it is long enough."""
_CURVED_MM = 0.35
AT_REST_MM = 0.2
"""A papilla whose base never gets so far, as on the axis of a twist, cannot slip further."""
AHEAD_MM = np.array([0.06, 0.12, 0.25])
"""Ways ahead of the fit at which what is missing is looked at."""
LACKS = np.array([0.6, 0.45, 0.35])
"""A knee lies where this share of the expected motion is missing there, and more than noise is."""
_SURE_MM, _SURE_LACK = 0.4, 0.45
_SIGMAS, _LEAST_PX = 5.0, 0.08
_LEAST_GAIN = 0.3
"""px/mm; a marker that follows by less shows nothing."""
_FEWEST = 8
_MOVED_PX = 0.2
_KNOTS = 81
_CORRELATED = 6.0
"""Neighbouring samples that err together: the arm's tremor, and thresholds of single pixels."""

_WIDER = 1.4
"""Stretch of the intervals: a knee is not quite one, and simulated slips ask for it."""


@dataclass(frozen=True)
class PapillaSlips:
    """Slips of m papillae over n slices.

    Attributes:
        knee_mm, low_mm, high_mm: (m,) way of the papilla's base at which it began to slip, and its
            central 95 %; NaN where it did not.
        distance_mm: (n, m) distance slid, NaN where unknown.
        sigma_mm: (n, m) its standard deviation.
        gain: (m,) px/mm at the knee, or at the end.
    """

    knee_mm: F64
    low_mm: F64
    high_mm: F64
    distance_mm: F64
    sigma_mm: F64
    gain: F64


def slips(
    way_mm: F64, moved_px: F64, sigma_px: F64, first: int, backlash_px: float
) -> PapillaSlips:
    """Find each papilla's slip.

    Args:
        way_mm: (n, m) distance of each base from where it was at rest.
        moved_px: (n, m) displacement of each marker along its base's motion, NaN where unknown.
        sigma_px: (n, m).
        first: the first slice of the motion.
        backlash_px: of the track, after a marker's reversal.
    """
    n, m = way_mm.shape
    knees, gains = np.full((3, m), np.nan), np.full(m, np.nan)
    distance, sigma = np.full((n, m), np.nan), np.full((n, m), np.nan)
    for marker in range(m):
        known = np.flatnonzero(np.isfinite(moved_px[:, marker]))
        known = known[known >= first]
        if len(known) < 8:
            continue
        s, y = way_mm[known, marker], moved_px[known, marker]
        if s.max() < AT_REST_MM:
            distance[known, marker], sigma[known, marker] = 0.0, s
            continue
        at, begin = _first_knee(s, y, BEFORE_MM, AHEAD_MM, LACKS)
        end = len(s)
        if at >= 0:
            knees[:, marker], gains[marker], level = _locate(s, y, int(at), int(begin))
            end = int(np.searchsorted(s, knees[1, marker]))
        stuck = _smooth(s[:end], y[:end])
        if at < 0:
            gains[marker] = _slope(s[:end], y[:end])
        gain = gains[marker]
        if not gain > _LEAST_GAIN:
            gains[marker], knees[:, marker] = np.nan, np.nan
            continue
        slid = np.empty(len(s))
        slid[:end] = (stuck - y[:end]) / gain
        rest = float(np.std(slid[:end])) if end > 8 else float(sigma_px[known[0], marker]) / gain
        wide = np.full(len(s), rest)
        if at >= 0:
            slid[end:] = (s[end:] - knees[1, marker]) - (y[end:] - level) / gain
            wide[end:] = np.hypot(rest, backlash_px / np.sqrt(12.0) / gain)
        distance[known, marker], sigma[known, marker] = slid, wide
        held = np.flatnonzero(np.isfinite(moved_px[:first, marker]))
        distance[held, marker] = moved_px[held, marker] / gain
        sigma[held, marker] = np.hypot(rest, sigma_px[held, marker] / gain)
    return PapillaSlips(knees[1], knees[0], knees[2], distance, sigma, gains)


def _smooth(s: F64, y: F64) -> F64:
    """Return a marker's displacement while it sticks, smooth over half of `BEFORE_MM`."""
    step = float(np.median(np.diff(s))) if len(s) > 1 else 0.0
    width = int(0.5 * BEFORE_MM / step) | 1 if step > 0.0 else 1
    if 5 <= width < len(y):
        return np.asarray(savgol_filter(y, width, 2))
    return np.asarray(np.polyval(np.polyfit(s, y, 1), s)) if len(y) > 4 else y


def _slope(s: F64, y: F64) -> float:
    """Return the gain over the last part of the travel, px/mm."""
    part = s > s[-1] - BEFORE_MM
    return float(np.polyfit(s[part], y[part], 1)[0]) if part.sum() > 4 else float("nan")


def _locate(s: F64, y: F64, at: int, begin: int) -> tuple[F64, float, float]:
    """Return low, middle and high of a knee (mm), and the gain (px/mm) and level (px) there."""
    stop = min(int(np.searchsorted(s, s[at] + 2 * AHEAD_MM[1])) + 1, len(s))
    part = slice(begin, stop)
    curved = s[at] - s[begin] > _CURVED_MM
    places = np.linspace(
        max(float(s[begin + 3]), float(s[at]) - 0.15), float(s[stop - 1]) - 0.02, _KNOTS
    )
    squares, gains, levels = _hinges(s[part], y[part], places, curved)
    count = stop - begin - (5 if curved else 4)
    noise = max(float(squares.min()) / max(count, 1), 1e-8)
    weight = np.exp(-(squares - squares.min()) / (2 * noise * _CORRELATED))
    share = np.concatenate(([0.0], np.cumsum((weight[1:] + weight[:-1]) / 2)))
    knee = np.interp(np.array([0.025, 0.5, 0.975]) * share[-1], share, places)
    knee = knee[1] + _WIDER * (knee - knee[1])
    return (
        knee,
        float(np.interp(knee[1], places, gains)),
        float(np.interp(knee[1], places, levels)),
    )


@njit(cache=True, nogil=True)
def _add_row(normal: Any, right: Any, row: Any, value: float) -> float:
    """Add an equation to normal equations; return the square of its right side."""
    for a in range(row.size):
        right[a] += row[a] * value
        for b in range(row.size):
            normal[a, b] += row[a] * row[b]
    return value * value


@njit(cache=True, nogil=True)
def _solved(normal: Any, right: Any, square: float) -> Any:
    """Solve normal equations; return the solution and the sum of squares that it leaves."""
    for a in range(right.size):
        normal[a, a] += 1e-9  # of few rows, they may be singular
    best: Any = np.linalg.solve(normal, right)
    return best, max(square - best @ right, 0.0)


@njit(cache=True, nogil=True)
def _fit(s: Any, y: Any, low: int, high: int, origin: float, curved: bool) -> Any:
    """Least-squares parabola (or line) over samples, and its residual's standard deviation.

    Returns:
        value and slope at the origin, curvature, standard deviation.
    """
    k = 3 if curved else 2
    normal, right, square = np.zeros((k, k)), np.zeros(k), 0.0
    for i in range(low, high):
        u, row = s[i] - origin, 1.0
        powers = np.empty(k)
        for a in range(k):
            powers[a] = row
            row *= u
        square += _add_row(normal, right, powers, y[i])
    best, left = _solved(normal, right, square)
    return best[0], best[1], (best[2] if curved else 0.0), np.sqrt(left / max(high - low - k, 1))


@njit(cache=True, nogil=True)
def _first_knee(s: Any, y: Any, before: float, ahead: Any, lacks: Any) -> Any:
    """First sample behind which a marker lacks what it should have moved, and its fit's first.

    Returns:
        two indices; -1 where there is none.
    """
    n, first = s.size, 0
    while first < n and abs(y[first]) < _MOVED_PX:
        first += 1
    begin = first
    for j in range(first + _FEWEST, n):
        while begin < j and s[begin] < s[j] - before:
            begin += 1
        if j - begin < _FEWEST:
            continue
        value, slope, bend, noise = _fit(s, y, begin, j, s[j], s[j] - s[begin] > _CURVED_MM)
        if slope < _LEAST_GAIN:
            continue
        for h in range(ahead.size):
            k = np.searchsorted(s, s[j] + ahead[h])
            if k + 1 >= n:
                break
            u = s[k] - s[j]
            off = value + slope * u + bend * u * u - (y[k - 1] + y[k] + y[k + 1]) / 3.0
            if off > lacks[h] * slope * u and off > _SIGMAS * noise and off > _LEAST_PX:
                # a tremor lets a marker lag for a while, too
                k = min(np.searchsorted(s, s[j] + _SURE_MM), n - 2)
                u = s[k] - s[j]
                off = value + slope * u - (y[k - 1] + y[k] + y[k + 1]) / 3.0
                if off > _SURE_LACK * slope * u:
                    return j, begin
    return -1, -1


@njit(cache=True, nogil=True)
def _hinges(s: Any, y: Any, places: Any, curved: bool) -> Any:
    """Squares left by a line or parabola that bends into another line, and its slope and level.

    Args:
        places: (k,) of the knee.
    """
    size = 4 if curved else 3
    squares, slopes, levels = np.empty(places.size), np.empty(places.size), np.empty(places.size)
    for p in range(places.size):
        normal, right, square = np.zeros((size, size)), np.zeros(size), 0.0
        row = np.empty(size)
        for i in range(s.size):
            u = s[i] - places[p]
            row[0], row[1], row[2] = 1.0, min(u, 0.0), max(u, 0.0)
            if curved:
                row[3] = row[1] * row[1]
            square += _add_row(normal, right, row, y[i])
        best, squares[p] = _solved(normal, right, square)
        levels[p], slopes[p] = best[0], best[1]
    return squares, slopes, levels
