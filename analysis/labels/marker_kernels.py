"""Locate markers in a frame near their predicted positions: the compiled part of tracking.

Each marker has its own square box. Grey levels are taken relative to the ground around it and
the white in its middle, cut off just above the one and just below the other, and summed with their
places: noise and light on the ground or inside the disc then weigh nothing, and the sum is the
disc's area to a twentieth of a percent, which is how a hidden part is noticed. Where boxes would
reach into neighbours or out of the picture, a disc with straight cuts takes the box's place.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, U8

LOST, WHOLE, PARTIAL = 0, 1, 2
FLANK = 0.06
"""Share of the contrast, at the foot and at the top of the rim, that is not looked at."""
LEAST_CONTRAST = 40.0
GRID_PX = 0.0035
"""Error of a centroid by the pixel grid, px RMS, measured on drawn discs of 20 px radius."""
FREE_SHARE = 0.002
"""A change of area up to this share is the pixel grid's; what is beyond it may be a hidden part."""
AREA, SIGMA, QUALITY, DARK, BRIGHT = 0, 1, 2, 3, 4
"""Columns of `found`."""
_CORNER_PX = 8
_KEEPS_UP = 0.02
"""Fastest lasting change of a marker's area (tilted plate, bent papilla), share per frame."""


@njit(cache=True, nogil=True)
def _line(frame: U8, y: int, left: int, right: int) -> tuple[float, int, float]:
    """Sum, pixels, and sum of squared steps of a piece of a row; none of it outside the picture."""
    left, right = max(left, 0), min(right, frame.shape[1])
    if not 0 <= y < frame.shape[0] or left >= right:
        return 0.0, 0, 0.0
    row = frame[y, left:right]
    total, squares = 0, 0
    for j in range(row.size):
        total += row[j]
    for j in range(row.size - 1):
        step: Any = np.int32(row[j + 1]) - np.int32(row[j])
        squares += min(step * step, 400)
    return float(total), right - left, float(squares)


@njit(cache=True, nogil=True)
def _levels(frame: Any, left: int, top: int, side: int, radius: float) -> Any:
    """Ground in a box's corners, white in its middle, noise, and how uneven the ground is."""
    squares, steps, known = 0.0, 0, 0
    lowest = second = np.inf
    highest = 0.0
    for corner in range(4):
        y = top + 1 if corner < 2 else top + side - 2
        x = left if corner % 2 == 0 else left + side - _CORNER_PX
        total, n, more = _line(frame, y, x, x + _CORNER_PX)
        if n > 0:
            mean = total / n
            known += 1
            highest = max(highest, mean)
            if mean < lowest:
                lowest, second = mean, lowest
            else:
                second = min(second, mean)
            squares, steps = squares + more, steps + n - 1
    if known == 0:
        return 0.0, 0.0, 0.0, 0.0
    dark = lowest if known == 1 else (lowest + second) / 2
    reach = max(int(0.5 * radius), 1)
    cx, cy = left + side // 2, top + side // 2
    total, n, more = _line(frame, cy, cx - reach, cx + reach + 1)
    squares, steps = squares + more, steps + max(n - 1, 0)
    bright = total / n if n > 0 else 0.0
    noise = np.sqrt(squares / (2 * steps)) if steps > 0 else 0.0
    return dark, bright, noise, highest - lowest


@njit(cache=True, nogil=True)
def _box_sums(
    frame: U8,
    left: int,
    top: int,
    side: int,
    low: int,
    high: int,
    c: npt.NDArray[np.int32],
    y: npt.NDArray[np.int32],
) -> tuple[int, int, int]:
    """Weight and weighted sums of x and y in a square box; four rows at a time.

    `c` and `y` are scratch, int32: column sums, and their running sums, which hold y.
    """
    for j in range(side):
        c[j] = 0
        y[j] = 0
    for block in range(side // 4):
        i = top + 4 * block
        r0, r1 = frame[i, left : left + side], frame[i + 1, left : left + side]
        r2, r3 = frame[i + 2, left : left + side], frame[i + 3, left : left + side]
        for j in range(side):
            a0 = np.int32(min(max(r0[j], low), high) - low)
            a1 = np.int32(a0 + np.int32(min(max(r1[j], low), high) - low))
            a2 = np.int32(a1 + np.int32(min(max(r2[j], low), high) - low))
            a3 = np.int32(a2 + np.int32(min(max(r3[j], low), high) - low))
            y[j] += np.int32(np.int32(4) * c[j] + a0 + a1 + a2 + a3)
            c[j] += a3
    total, sum_x, sum_y = 0, 0, 0
    for j in range(side):
        total += c[j]
        sum_x += int(j * np.int64(c[j]))
        sum_y += y[j]
    # a row's weight was added once for itself and once for each row below it
    return total, sum_x + left * total, (top + side) * total - sum_y


@njit(cache=True, nogil=True)
def _disc_sums(
    frame: U8, cx: int, cy: int, reach: float, cuts: F64, low: int, high: int
) -> tuple[int, int, int]:
    """The same in a disc, less what lies beyond a cut (x0, y0) in its direction (dx, dy)."""
    height, width = frame.shape
    far = int(np.ceil(reach))
    total, sum_x, sum_y = 0, 0, 0
    for i in range(max(0, cy - far), min(height, cy + far + 1)):
        half = int(np.sqrt(max(0.0, reach * reach - (i - cy) ** 2)))
        left, right = max(0, cx - half), min(width, cx + half + 1)
        for x0, y0, dx, dy in cuts:
            beyond = (i - y0) * dy
            if abs(dx) < 1e-9:
                right = left if beyond > 0 else right
            elif dx > 0:
                right = min(right, int(np.floor(x0 - beyond / dx)) + 1)
            else:
                left = max(left, int(np.ceil(x0 - beyond / dx)))
        for j in range(left, right):
            w: Any = np.int64(min(max(frame[i, j], low), high) - low)
            total += w
            sum_x += w * j
            sum_y += w * i
    return total, sum_x, sum_y


@njit(cache=True, nogil=True)
def _near_cuts(xy: Any, k: int, x: float, y: float, known: Any, reach: float, cuts: Any) -> Any:
    """The lines half-way to those neighbours of marker k that may look into its disc."""
    n = 0
    for other in range(xy.shape[0]):
        dx, dy = xy[other, 0] - x, xy[other, 1] - y
        apart = np.hypot(dx, dy)
        if other != k and known[other] and reach < apart < 2 * reach:
            cuts[n] = (x + dx / 2, y + dy / 2, dx / apart, dy / apart)
            n += 1
    return cuts[:n]


@njit(cache=True, nogil=True)
def _stands_free(
    xy: F64, k: int, left: int, top: int, side: int, radius: float, shape: tuple[int, int]
) -> bool:
    """Return True where a box lies in the image and no other marker can appear in it."""
    if left < 0 or top < 0 or left + side > shape[1] or top + side > shape[0]:
        return False
    half = side / 2
    for other in range(xy.shape[0]):
        if other != k:
            dx = max(abs(xy[other, 0] - left - half) - half, 0.0)
            dy = max(abs(xy[other, 1] - top - half) - half, 0.0)
            if dx * dx + dy * dy < (radius + 2) ** 2:
                return False
    return True


@njit(cache=True, nogil=True)
def _one(
    frame: Any,
    xy: Any,
    k: int,
    known: Any,
    radius: float,
    margin: float,
    found: Any,
    area: float,
    tolerance: float,
    cuts: Any,
    c: Any,
    y_sums: Any,
) -> Any:
    """Marker k from its prediction: column, row, state; `found[k]` is filled."""
    height, width = frame.shape
    reach = radius + margin
    # whole vectors of pixels
    side = 16 * int(np.ceil(2 * reach / 16))
    x, y = xy[k, 0], xy[k, 1]
    before_dark, before_bright = found[k, DARK], found[k, BRIGHT]
    found[k, QUALITY] = 0.0
    for _ in range(8):
        if not (-reach < x < width + reach and -reach < y < height + reach):
            break
        cx, cy = int(np.round(x)), int(np.round(y))
        left, top = cx - side // 2, cy - side // 2
        dark, bright, noise, uneven = _levels(frame, left, top, side, radius)
        contrast = bright - dark
        usual = before_bright - before_dark
        trusted = contrast > max(LEAST_CONTRAST, 0.5 * usual)
        if not trusted:
            # far off, or hidden: what it looked like before may lead to it
            dark, bright, contrast = before_dark, before_bright, usual
        if not _stands_free(xy, k, left, top, side, radius, frame.shape):
            uneven = 0.0
        # light on one side of the ground must not count as white
        flank = max(FLANK * contrast, 3.5 * noise + 1.0, uneven + 1.0)
        low_level, high_level = np.round(dark + flank), np.round(bright - flank)
        if not (low_level >= 0 and low_level + 8 < high_level and high_level <= 255):
            break
        low, high = np.uint8(low_level), np.uint8(high_level)
        if side <= c.size and _stands_free(xy, k, left, top, side, radius, frame.shape):
            total, sum_x, sum_y = _box_sums(frame, left, top, side, low, high, c, y_sums)
            free = True
        else:
            near = _near_cuts(xy, k, x, y, known, reach, cuts)
            total, sum_x, sum_y = _disc_sums(frame, cx, cy, reach, near, low, high)
            free = near.shape[0] == 0
        covered = total / (high_level - low_level)
        if covered < 0.3 * area:
            break
        x, y = sum_x / total, sum_y / total
        if (x - cx) ** 2 + (y - cy) ** 2 > (margin - 1) ** 2:
            # the box is moved on until the whole marker lies inside it
            continue
        inside = radius + 1 <= x <= width - 2 - radius and radius + 1 <= y <= height - 2 - radius
        hidden = abs(covered / area - 1.0)
        found[k, AREA] = covered
        if not inside:
            return x, y, PARTIAL
        if not trusted or hidden > tolerance:
            break
        found[k, DARK], found[k, BRIGHT] = dark, bright
        light = max(uneven - 3.0 * noise, 0.0) / contrast
        rim = noise / contrast * np.sqrt(0.6 / (np.pi * radius))
        part = radius * max(hidden - (FREE_SHARE if free else 0.015), 0.0)
        grid = GRID_PX * np.sqrt(20.0 / radius)
        found[k, SIGMA] = np.sqrt(grid**2 + rim**2 + part**2 + (0.5 * light) ** 2)
        found[k, QUALITY] = (
            (1.0 - hidden / tolerance) * min(1.0, contrast / usual) * max(0.0, 1.0 - light)
        )
        return x, y, WHOLE
    return xy[k, 0], xy[k, 1], LOST


@njit(cache=True, nogil=True)
def follow(
    frame: Any,
    xy: Any,
    selected: Any,
    radius: float,
    margin: float,
    area: Any,
    tolerance: float,
    state: Any,
    found: Any,
) -> Any:
    """Move the markers `selected` of `xy` from their predictions to their centroids.

    Args:
        frame: (h, w) uint8.
        xy: (m, 2), changed. selected: (m,) bool.
        radius, margin: of the discs, and of the area searched around them, px.
        area: (m,) what each usually covers, px; follows what is measured, slowly.
        tolerance: share of it by which a marker may differ.
        state: (m,) int64, changed to LOST, WHOLE or PARTIAL (cut by the picture's edge).
        found: (m, 5), changed; the last two columns are read, as they were a frame before.

    Returns:
        how many of those selected are lost, and how many of all are whole.
    """
    predicted = xy.copy()
    known = state != LOST
    cuts = np.empty((xy.shape[0], 4))
    c, y_sums = np.empty(256, np.int32), np.empty(256, np.int32)
    # again when something moved far: the cuts were at the neighbours' old places
    for _ in range(3):
        farthest = 0.0
        for k in range(xy.shape[0]):
            if not selected[k]:
                continue
            x, y, state[k] = _one(
                frame, xy, k, known, radius, margin, found, area[k], tolerance, cuts, c, y_sums
            )
            if state[k] != LOST:
                farthest = max(farthest, np.hypot(x - xy[k, 0], y - xy[k, 1]))
                xy[k, 0], xy[k, 1] = x, y
        if farthest < 1.5:
            break
    lost = 0
    for a in range(xy.shape[0]):
        for b in range(a):
            # two on one blob: it belongs to the one that had less far to go
            if state[a] != LOST and state[b] != LOST:
                apart = (xy[a, 0] - xy[b, 0]) ** 2 + (xy[a, 1] - xy[b, 1]) ** 2
                if apart < radius * radius:
                    way_a = np.hypot(xy[a, 0] - predicted[a, 0], xy[a, 1] - predicted[a, 1])
                    way_b = np.hypot(xy[b, 0] - predicted[b, 0], xy[b, 1] - predicted[b, 1])
                    state[a if way_a > way_b else b] = LOST
    whole = 0
    for k in range(xy.shape[0]):
        whole += state[k] == WHOLE
        if selected[k]:
            lost += state[k] == LOST
            if state[k] == WHOLE:
                area[k] += _KEEPS_UP * (found[k, AREA] - area[k])
    return lost, whole
