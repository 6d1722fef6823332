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

F64 = npt.NDArray[np.float64]
I64 = npt.NDArray[np.int64]
Look = Callable[[I64], tuple[F64, F64]]
"""From rising times, ns, (k,), to tips (k, n, 2) and heights of the plate (k,), in mm."""

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
    begin, middle, end = (look(mid_ns + shift) for shift in (-half, 0, half))
    tips = (begin[0] + 4.0 * middle[0] + end[0]) / 6.0
    plate = (begin[1] + 4.0 * middle[1] + end[1]) / 6.0
    # one more thing that moves: the plate, as (m, 1, 2)
    path = [
        np.concatenate([places, np.stack([0.0 * height, height], axis=-1)[:, None]], axis=1)
        for places, height in (begin, middle, end)
    ]
    way = px_per_mm * (_length(path[1] - path[0]) + _length(path[2] - path[1]))
    bend = px_per_mm * _length(path[0] - 2.0 * path[1] + path[2])
    farthest = way.max(axis=1, initial=0.0)
    ways = {}
    for index in np.flatnonzero(
        (farthest >= STILL_PX) | (bend.max(axis=1, initial=0.0) >= BEND_PX)
    ).tolist():
        count = min(max(_FEWEST, math.ceil(farthest[index] / _STEP_PX)), _MOST)
        # midpoints of equal shares, to a nanosecond
        shares = (2 * np.arange(count, dtype=np.int64) + 1) * (2 * half) // (2 * count)
        seen = Way(*look(mid_ns[index] - half + shares))
        tips[index], plate[index] = seen.tips_mm.mean(axis=0), seen.plate_mm.mean()
        ways[index] = seen
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
