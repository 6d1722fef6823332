"""The four sides of a dark square on white, each a line to a hundredth of a pixel.

Refining a corner looks at a few pixels about a point and depends on how the pixel grid lies there;
a side is seen in a hundred. Each is measured along its normals: the white share of a short profile
gives the edge of the black. Profiles that disagree with the rest are left out, so that a marker
which is partly hidden or glares in places is still measured.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sliplab.storage.kernels import njit

LEAST_CONTRAST = 30.0
_PROFILES = 32
_SAMPLES = 17
GRID_PX = 0.018
"""Error of a moving centre by the pixel grid, px RMS, measured on drawn markers."""
_KEPT = 0.6
"""Share of a side's profiles that have to agree."""


@njit(cache=True, nogil=True)
def _grey(frame: Any, x: float, y: float) -> float:
    """Return the bilinear grey level; NaN outside the image."""
    if not (0.0 <= x < frame.shape[1] - 1 and 0.0 <= y < frame.shape[0] - 1):
        return np.nan
    j, i = int(x), int(y)
    u, v = x - j, y - i
    above = (1.0 - u) * frame[i, j] + u * frame[i, j + 1]
    below = (1.0 - u) * frame[i + 1, j] + u * frame[i + 1, j + 1]
    return (1.0 - v) * above + v * below


@njit(cache=True, nogil=True)
def _side(frame: Any, ax: float, ay: float, bx: float, by: float, reach: float) -> Any:
    """Return the side's outward offsets at a and at b, and its scatter, px; NaN if lost.

    Corners go clockwise in the image, so that outwards is to the left of the direction from a to b.
    """
    length = np.hypot(bx - ax, by - ay)
    nx, ny = (by - ay) / length, -(bx - ax) / length
    offset = np.empty(_PROFILES)
    step = 2.0 * reach / (_SAMPLES - 1)
    for k in range(_PROFILES):
        share = 0.1 + 0.8 * k / (_PROFILES - 1)
        x, y = ax + share * (bx - ax), ay + share * (by - ay)
        total = 0.0
        for j in range(_SAMPLES):
            d = -reach + j * step
            total += _grey(frame, x + d * nx, y + d * ny)
        dark = _grey(frame, x - reach * nx, y - reach * ny)
        bright = _grey(frame, x + reach * nx, y + reach * ny)
        dark += _grey(frame, x - (reach - step) * nx, y - (reach - step) * ny)
        bright += _grey(frame, x + (reach - step) * nx, y + (reach - step) * ny)
        contrast = (bright - dark) / 2
        if contrast > LEAST_CONTRAST:
            white = (total / _SAMPLES - dark / 2) / contrast
            offset[k] = reach * (_SAMPLES / (_SAMPLES - 1.0)) * (1.0 - 2.0 * white)
        else:
            offset[k] = np.nan
    level, slope, scatter, n = 0.0, 0.0, np.inf, 0
    near = np.sort(offset)  # NaN last
    known = 0
    for k in range(_PROFILES):
        known += np.isfinite(near[k])
    if known < _KEPT * _PROFILES:
        return np.nan, np.nan, np.nan
    level = near[known // 2]
    limit = 1.0
    for _ in range(3):
        s, st, stt, sd, std = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(_PROFILES):
            t = 0.8 * k / (_PROFILES - 1) - 0.4
            if abs(offset[k] - level - slope * t) <= limit:
                s, st, stt = s + 1.0, st + t, stt + t * t
                sd, std = sd + offset[k], std + offset[k] * t
        n = int(s)
        if n < _KEPT * _PROFILES:
            return np.nan, np.nan, np.nan
        slope = (s * std - st * sd) / (s * stt - st * st)
        level = (sd - slope * st) / s
        squares = 0.0
        for k in range(_PROFILES):
            t = 0.8 * k / (_PROFILES - 1) - 0.4
            away = offset[k] - level - slope * t
            if abs(away) <= limit:
                squares += away * away
        scatter = np.sqrt(squares / n)
        limit = max(3.0 * scatter, 0.05)
    return level - 0.5 * slope, level + 0.5 * slope, scatter


@njit(cache=True, nogil=True)
def refine_square(frame: Any, corners: Any, rounds: int) -> Any:
    """The dark square near `corners`, (4, 2), clockwise in the picture.

    Returns:
        its corners, and the standard deviation of its centre, px; NaN where a side was not found.
    """
    result = corners.copy()
    scatters = 0.0
    for number in range(rounds):
        shortest = np.inf
        for k in range(4):
            a, b = result[k], result[(k + 1) % 4]
            shortest = min(shortest, np.hypot(b[0] - a[0], b[1] - a[1]))
        reach = min(6.0, 0.7 * shortest / 6.0)
        lines = np.empty((4, 4))
        scatters, farthest = 0.0, 0.0
        for k in range(4):
            ax, ay = result[k]
            bx, by = result[(k + 1) % 4]
            at_a, at_b, scatter = _side(frame, ax, ay, bx, by, reach)
            if not np.isfinite(at_a):
                return result, np.nan
            length = np.hypot(bx - ax, by - ay)
            nx, ny = (by - ay) / length, -(bx - ax) / length
            lines[k] = (ax + at_a * nx, ay + at_a * ny, bx + at_b * nx, by + at_b * ny)
            scatters += scatter * scatter
            farthest = max(farthest, abs(at_a), abs(at_b))
        for k in range(4):
            # where this side meets the one before it
            x1, y1, x2, y2 = lines[k - 1]
            x3, y3, x4, y4 = lines[k]
            across = (x1 - x2) * (y3 - y4) - (y1 - y2) * (x3 - x4)
            if abs(across) < 1e-9:
                return result, np.nan
            one, other = x1 * y2 - y1 * x2, x3 * y4 - y3 * x4
            result[k, 0] = (one * (x3 - x4) - (x1 - x2) * other) / across
            result[k, 1] = (one * (y3 - y4) - (y1 - y2) * other) / across
        if number > 0 and farthest < 0.5 * reach:
            break
    if farthest > 0.6 * reach:
        return result, np.nan
    return result, np.sqrt(scatters / 4.0 / _PROFILES / 2.0 + GRID_PX**2)


@njit(cache=True, nogil=True)
def cells(frame: Any, corners: Any) -> Any:
    """Grey levels at the centres of the 6 x 6 cells of the square `corners`, (36,).

    Projective: a tilted square's cells lie where its diagonals say.
    """
    x0, y0 = corners[0]
    x1, y1 = corners[1]
    x2, y2 = corners[2]
    x3, y3 = corners[3]
    # Heckbert's square to quadrilateral
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dx2, dy1, dy2 = x1 - x2, x3 - x2, y1 - y2, y3 - y2
    across = dx1 * dy2 - dx2 * dy1
    g, h = (sx * dy2 - dx2 * sy) / across, (dx1 * sy - sx * dy1) / across
    a, b = x1 - x0 + g * x1, x3 - x0 + h * x3
    d, e = y1 - y0 + g * y1, y3 - y0 + h * y3
    result = np.empty(36)
    for i in range(6):
        for j in range(6):
            u, v = (j + 0.5) / 6.0, (i + 0.5) / 6.0
            w = g * u + h * v + 1.0
            result[6 * i + j] = _grey(frame, (a * u + b * v + x0) / w, (d * u + e * v + y0) / w)
    return result
