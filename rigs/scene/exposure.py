"""What a camera sees during an exposure: one place for most frames, the way for the few that blur.

At the speeds of a slide nothing moves a tenth of a pixel while the shutter is open, and such frames
must cost nothing extra. A falling plate and a tip that jumps are smeared, and then the picture is
the mean over places along the way (midpoint rule).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from numba import njit

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Look = Callable[[I64], tuple[F64, F64]]
"""From times, ns, (k,), to tips (k, n, 2) and heights of the plate (k,), in mm.

Times rise within an exposure, and from exposure to exposure: none is before the first or after the
last of them.
"""

STILL_PX = 0.1
"""Shorter ways than this are drawn at their mean place."""
BEND_PX = 0.025
"""Unless they bend: of a kink in the way, Simpson's rule misses up to an eighth of the bend."""
_STEP_PX = 0.25
_FEWEST, _MOST = 32, 128


@dataclass(frozen=True)
class Way:
    """Places of everything at equal shares of one exposure."""

    tips_mm: F64
    """(s, n, 2)."""
    plate_mm: F64
    """(s,)."""


@dataclass(frozen=True)
class Exposures:
    """Mean places over each of m exposures, and the ways of those in which something moved."""

    tips_mm: F64
    """(m, n, 2)."""
    plate_mm: F64
    """(m,)."""
    ways: Mapping[int, Way] = field(default_factory=dict)
    """By index of the exposure."""


def expose(look: Look, mid_ns: I64, exposure_ns: int, px_per_mm: float) -> Exposures:
    """Look at the scene during exposures of `exposure_ns` about `mid_ns` (rising, (m,)).

    Places that hardly move are averaged by Simpson's rule over beginning, middle and end.
    """
    half = exposure_ns // 2
    # one look for everything: what it costs is the call
    tips, plate = look((mid_ns[:, None] + np.array([-half, 0, half], np.int64)).ravel())
    tips, plate, farthest, bent = _average(
        tips.reshape(-1, 3, *tips.shape[1:]), plate.reshape(-1, 3), px_per_mm
    )
    smeared = np.flatnonzero((farthest >= STILL_PX) | (bent >= BEND_PX))
    if not len(smeared):
        return Exposures(tips, plate)
    counts = np.clip(np.ceil(farthest[smeared] / _STEP_PX).astype(np.int64), _FEWEST, _MOST)
    ways: dict[int, Way] = {}
    for count in np.unique(counts).tolist():
        # ways of as many places are looked at together
        here = smeared[counts == count]
        # midpoints of equal shares, to a nanosecond
        shares = (2 * np.arange(count, dtype=np.int64) + 1) * (2 * half) // (2 * count)
        along, heights = look((mid_ns[here, None] - half + shares).ravel())
        along = along.reshape(-1, count, *along.shape[1:])
        heights = heights.reshape(-1, count)
        tips[here], plate[here] = along.mean(axis=1), heights.mean(axis=1)
        ways.update(zip(here.tolist(), map(Way, along, heights), strict=True))
    return Exposures(tips, plate, ways)


def moved(way_px: F64) -> npt.NDArray[np.bool_]:
    """Which of n things need their way drawn: (n,) from their places along it, px, (s, n, 2)."""
    count = len(way_px)
    steps = _length(np.diff(way_px, axis=0)).sum(axis=0)
    # from the first midpoint to the last is less than the whole way
    result: npt.NDArray[np.bool_] = steps * count >= STILL_PX * (count - 1)
    return result


def _length(vector: F64) -> F64:
    result: F64 = np.hypot(vector[..., 0], vector[..., 1])
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _average(tips, plate, px_per_mm):  # type: ignore[no-untyped-def]
    """Simpson's mean of tips (m, 3, n, 2) and plate (m, 3) over beginning, middle and end.

    Also the longest way of anything in each exposure, and its largest bend, px, (m,).
    """
    m, _, n, _ = tips.shape
    mean, height = np.empty((m, n, 2)), np.empty(m)
    way, bend = np.empty(m), np.empty(m)
    for k in range(m):
        low, middle, high = plate[k]
        height[k] = (low + 4.0 * middle + high) / 6.0
        farthest = abs(middle - low) + abs(high - middle)
        bent = abs(low - 2.0 * middle + high)
        for i in range(n):
            (x0, y0), (x1, y1), (x2, y2) = tips[k, 0, i], tips[k, 1, i], tips[k, 2, i]
            mean[k, i, 0] = (x0 + 4.0 * x1 + x2) / 6.0
            mean[k, i, 1] = (y0 + 4.0 * y1 + y2) / 6.0
            first = math.sqrt((x1 - x0) ** 2 + (y1 - y0) ** 2)
            second = math.sqrt((x2 - x1) ** 2 + (y2 - y1) ** 2)
            farthest = max(farthest, first + second)
            bow_x, bow_y = x0 - 2.0 * x1 + x2, y0 - 2.0 * y1 + y2
            bent = max(bent, math.sqrt(bow_x**2 + bow_y**2))
        way[k], bend[k] = px_per_mm * farthest, px_per_mm * bent
    return mean, height, way, bend
