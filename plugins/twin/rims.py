"""Discs before and after a motion, from how often each pixel fired in between.

A pixel counts the thresholds that its log intensity has risen by: positive events less negative
ones, cut towards zero. So counts are an image of the discs after the motion less one of those
before it, in thresholds, and a model of both discs is fitted to the counts round each of them:
centre and radius before, displacement and growth, width of the logistic edge, and contrast. Times
of events play no part, nor does the way that the discs took.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64

I32 = np.typing.NDArray[np.int32]

COLUMN, ROW, RADIUS, RIGHT, DOWN, GROWN, EDGE, CONTRAST = range(8)
"""Columns of a table of discs: centre and radius before the motion, px; displacement of the centre
and growth of the radius in it, px; scale of the logistic edge, px; contrast in thresholds."""
HIDDEN = -(1 << 30)
"""Count of a pixel that says nothing, as it is hot."""
REACH = 6.0
"""Edges are looked at so many scales far."""
FULL = 0.95
"""A pixel that saw this share of the contrast has seen nearly all of it."""
EDGE_PX = (0.15, 5.0)
CONTRASTS = (1.5, 200.0)
"""Limits of the search."""
_FEWEST = 20
_ROUNDING, _MISMATCH = 0.3, 0.15
"""Standard deviation of a count: of cutting it to a whole number, and as a share of it."""
_OUTLIER = 5.0
_ITERATIONS = 12
_DONE_PX = 2e-3
_STRIDE_PX = 4.0


@dataclass(frozen=True)
class RimFit:
    """Discs that were fitted to the counts of one motion.

    Attributes:
        discs: (m, 8), see `COLUMN` and the following; NaN where there was nothing to fit.
        sigma: (m, 8) standard deviations; 0 for what was given.
        full: of pixels that saw nearly the whole contrast come (0) and go (1): how many, the sum of
            what each would have counted of all of it, not cut to whole numbers, and the sum of
            the squares of that, (m, 2, 3).
    """

    discs: F64
    sigma: F64
    full: F64

    @property
    def swept_px(self) -> F64:
        """Displacement of each disc, (m,)."""
        result: F64 = np.hypot(self.discs[:, RIGHT], self.discs[:, DOWN])
        return result


def fit_rims(counts: I32, background: float, start: F64, *, shape: bool) -> RimFit:
    """Fit discs to counts.

    Args:
        counts: positive less negative events of each pixel, (height, width); `HIDDEN` where they
            say nothing.
        background: mean count of pixels that see no disc.
        start: first guesses, (m, 8); a row that is not finite is left out.
        shape: fit the edge and the contrast of each disc too.
    """
    discs, sigma, full = _fit_all(counts, background, np.ascontiguousarray(start), shape)
    return RimFit(discs, sigma, full)


@njit(cache=True, nogil=True, error_model="numpy")
def first_moments(counts: Any, discs: Any, reach: float) -> Any:
    """Sums of the counts of each disc: of their squares, sizes, and moments, (m, 4).

    A pixel belongs to the disc whose way it is nearest to. Moments are about the centre before the
    motion, columns to the right and rows downwards.

    Args:
        discs: (m, 8), with the ways as far as they are known.
        reach: in radii; pixels farther from all ways belong to none.
    """
    height, width = counts.shape
    sums = np.zeros((discs.shape[0], 4))
    for y in range(height):
        for x in range(width):
            n = counts[y, x]
            if n == 0 or n == HIDDEN:
                continue
            nearest, least = -1, np.inf
            for i in range(discs.shape[0]):
                dx, dy = x - discs[i, COLUMN], y - discs[i, ROW]
                far = reach * discs[i, RADIUS]
                u, v = discs[i, RIGHT], discs[i, DOWN]
                square = u * u + v * v
                if dx * dx + dy * dy > 2.0 * (far * far + square):
                    continue
                along = min(max((dx * u + dy * v) / square, 0.0), 1.0) if square > 0.0 else 0.0
                ex, ey = dx - along * u, dy - along * v
                away = ex * ex + ey * ey
                if away < least and away < far * far:
                    nearest, least = i, away
            if nearest >= 0:
                sums[nearest, 0] += n * n
                sums[nearest, 1] += abs(n)
                sums[nearest, 2] += n * (x - discs[nearest, COLUMN])
                sums[nearest, 3] += n * (y - discs[nearest, ROW])
    return sums


@njit(cache=True, nogil=True, error_model="numpy")
def _fit_all(counts: Any, background: float, start: Any, shape: bool) -> Any:
    count = start.shape[0]
    discs, sigma = np.full((count, 8), np.nan), np.full((count, 8), np.nan)
    full = np.zeros((count, 2, 3))
    for i in range(count):
        p = start[i].copy()
        if not np.isfinite(p.sum()):
            continue
        if _fit(counts, background, p, sigma[i], shape, full[i]):
            discs[i] = p
        else:
            sigma[i] = np.nan
            full[i] = 0.0
    return discs, sigma, full


@njit(cache=True, nogil=True, error_model="numpy")
def _fit(counts: Any, background: float, p: Any, sigma: Any, shape: bool, full: Any) -> bool:
    """Fit one disc by Gauss and Newton's method, damped; see `fit_rims`.

    Args:
        p: first guess, (8,), written. sigma, full: as in `RimFit`, written.

    Returns:
        whether it was found.
    """
    free = 8 if shape else 6
    normal, right = np.zeros((8, 8)), np.zeros(8)
    for _ in range(_ITERATIONS):
        used = _normal_equations(counts, background, p, normal, right, full)
        if used < _FEWEST:
            return False
        for k in range(8):
            if k >= free:
                normal[k, :] = 0.0
                normal[:, k] = 0.0
                normal[k, k] = 1.0
                right[k] = 0.0
            else:
                normal[k, k] = normal[k, k] * 1.001 + 1e-6
        step = np.linalg.solve(normal, right)
        longest = max(np.abs(step[:7]).max(), 1e-12)
        step *= min(1.0, _STRIDE_PX / longest)
        p += step
        p[EDGE] = min(max(p[EDGE], EDGE_PX[0]), EDGE_PX[1])
        p[CONTRAST] = min(max(p[CONTRAST], CONTRASTS[0]), CONTRASTS[1])
        if not np.isfinite(p.sum()) or p[RADIUS] < 2.0 or p[RADIUS] + p[GROWN] < 2.0:
            return False
        if longest < _DONE_PX:
            break
    spread = np.diag(np.linalg.inv(normal))
    for k in range(8):
        sigma[k] = np.sqrt(spread[k]) if k < free else 0.0
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _normal_equations(
    counts: Any, background: float, p: Any, normal: Any, right: Any, full: Any
) -> int:
    """Sum up the weighted normal equations at parameters `p`, written to `normal` and `right`.

    Returns:
        how many pixels saw more than a threshold, by the model.
    """
    height, width = counts.shape
    column, row, radius = p[COLUMN], p[ROW], p[RADIUS]
    column_1, row_1, radius_1 = column + p[RIGHT], row + p[DOWN], radius + p[GROWN]
    edge, contrast = p[EDGE], p[CONTRAST]
    reach = REACH * edge
    normal[:], right[:], full[:] = 0.0, 0.0, 0.0
    slope, used = np.empty(8), 0
    wide = max(radius, radius_1) + reach
    left, last = int(min(column, column_1) - wide), int(max(column, column_1) + wide) + 1
    top, bottom = int(min(row, row_1) - wide), int(max(row, row_1) + wide) + 1
    for y in range(max(top, 0), min(bottom + 1, height)):
        for x in range(max(left, 0), min(last + 1, width)):
            if counts[y, x] == HIDDEN:
                continue
            dx, dy, ex, ey = x - column, y - row, x - column_1, y - row_1
            away, away_1 = np.sqrt(dx * dx + dy * dy), np.sqrt(ex * ex + ey * ey)
            off, off_1 = away - radius, away_1 - radius_1
            if min(off, off_1) > reach or max(off, off_1) < -reach:
                continue
            share, share_1 = 1.0 / (1.0 + np.exp(off / edge)), 1.0 / (1.0 + np.exp(off_1 / edge))
            seen = share_1 - share
            z = contrast * seen
            size = abs(z)
            # a level that thresholds are scattered about is cut to whole ones: half of one is lost
            if size > 1.0:
                lost, rate = size - 0.5, 1.0
                used += 1
            else:
                lost, rate = 0.5 * size**5, 2.5 * size**4
            value = lost if z >= 0.0 else -lost
            count = counts[y, x] - background
            if abs(seen) > FULL:
                k = 0 if seen > 0.0 else 1
                whole = (abs(count) + 0.5) / abs(seen)
                full[k, 0] += 1.0
                full[k, 1] += whole
                full[k, 2] += whole * whole
            miss = count - value
            variance = _ROUNDING + (_MISMATCH * z) ** 2
            weight = 1.0 / variance
            far = abs(miss) / np.sqrt(variance)
            if far > _OUTLIER:
                weight *= _OUTLIER / far
            steep, steep_1 = share * (1.0 - share) / edge, share_1 * (1.0 - share_1) / edge
            away, away_1 = max(away, 1e-6), max(away_1, 1e-6)
            g, g_1 = rate * contrast * steep, rate * contrast * steep_1
            slope[RIGHT], slope[DOWN], slope[GROWN] = g_1 * ex / away_1, g_1 * ey / away_1, g_1
            slope[COLUMN] = slope[RIGHT] - g * dx / away
            slope[ROW] = slope[DOWN] - g * dy / away
            slope[RADIUS] = g_1 - g
            slope[EDGE] = (g_1 * off_1 - g * off) / edge
            slope[CONTRAST] = rate * seen
            for j in range(8):
                right[j] += weight * slope[j] * miss
                for k in range(j + 1):
                    normal[j, k] += weight * slope[j] * slope[k]
    for j in range(8):
        for k in range(j + 1, 8):
            normal[j, k] = normal[k, j]
    return used
