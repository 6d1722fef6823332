"""A clock map from what a host can say of a device's clock: not before, and not after.

Where no pulse reaches a device, the computer still knows bounds. A clock that is read is read
between the question and the answer; a message was sent before it arrived, and not longer before
than its way can take. Every such pair of bounds leaves a strip of lines that are possible; the map
is the middle of what all of them leave, and its uncertainty is not an estimate but half the width
of that strip.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from storage.clockmap import ClockMap

Ints = NDArray[np.int64]
Floats = NDArray[np.float64]

MIN_PAIRS = 3


class BoundsContradictError(ValueError):
    """No straight clock fits between the bounds: it jumped, or a bound is wrong."""


@dataclass(frozen=True)
class BoundedClock:
    """A clock map with hard bounds.

    Attributes:
        map: device ns to reference ns, the middle of all lines that are possible.
        uncertainty_ns: the map is off by no more between the first and the last pair, ns.
        drift_ppm, drift_error_ppm: what the reference gains, and half the range that is possible.
        pairs: how many pairs of bounds there were.
        tightest_ns: width of the narrowest of them.
    """

    map: ClockMap
    uncertainty_ns: float
    drift_ppm: float
    drift_error_ppm: float
    pairs: int
    tightest_ns: int


def fit_bounds(
    device_ns: Ints, not_before_ns: Ints, not_after_ns: Ints, max_drift_ppm: float
) -> BoundedClock:
    """The clock map that lies between bounds.

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
        raise BoundsContradictError("an instant's earliest time lies after its latest one")
    origin, image = int(device[0]), int(low[0])
    x = (device - origin).astype(np.float64)
    below, above = ((b - image - (device - origin)).astype(np.float64) for b in (low, high))
    below, above = below[_hull(x, below, 1.0)], above[_hull(x, -above, 1.0)]
    x_below, x_above = x[_hull_of(x, device, low, origin, image)], x[_hull_of(x, device, high, origin, image, -1.0)]
    raise NotImplementedError
