"""The friction cone of a tip: how its force leaves it, and which way the tip slides.

Where the direction turns, the tip is dragged behind its base on a line of the cone's radius: a
tractrix, tan(theta/2) = tan(theta0/2) exp(-s / rho). That is exact for linear springs also while
the radius grows or shrinks linearly, rho being then its logarithmic mean. A step of the solver
takes from it only the direction of the step's slip, which lies between those of the force at both
ends: an error of second order there is one of third order in the tip's place.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.smooth import decayed, logarithm

_BETWEEN = 1.0 - 1e-9


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slides_on(fx, fy, dx, dy, start, end, strengthening):  # type: ignore[no-untyped-def]
    """Tell that the force f + s d of a sliding tip never enters its cone before it ends outside.

    A tip slides as long as its speed is above zero. Where friction rises with speed, its force then
    lies outside the cone of friction at rest, whose radius goes from `start` to `end`, and may fall
    for a while; without, it lies on it, and must not be taken inwards at first.
    """
    grows = end - start
    a = dx * dx + dy * dy - grows * grows
    half_b = fx * dx + fy * dy - start * grows
    c = fx * fx + fy * fy - start * start if strengthening > 0.0 else 0.0
    return half_b >= 0.0 or half_b <= -a or half_b * half_b < a * c


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def raised(fx, fy, before, after):  # type: ignore[no-untyped-def]
    """Radii of a cone at both ends of a step, made as large as the force is that lies on it.

    The speed of sliding raises friction, and goes on as it does.
    """
    size = np.sqrt(fx * fx + fy * fy)
    return size, after * (size / before) if before > 0.0 else after


@njit(cache=True, nogil=True, error_model="numpy")
def leaves_at(fx, fy, dx, dy, start, end):  # type: ignore[no-untyped-def]
    """Share of a step at which the force f + s d last leaves a cone from `start` to `end`."""
    a = dx * dx + dy * dy - (end - start) ** 2
    half_b = fx * dx + fy * dy - start * (end - start)
    c = fx * fx + fy * fy - start * start
    # a force outside at first is one that comes in and leaves again, or rounding
    c = c if half_b < 0.0 < a else min(c, 0.0)
    if a == 0.0:
        return min(max(-0.5 * c / half_b, 0.0), 1.0) if half_b > 0.0 else 0.0
    root = np.sqrt(max(half_b * half_b - a * c, 0.0))
    # the larger root if the force outruns the cone, without cancellation
    share = -c / (half_b + root) if half_b > 0.0 else (root - half_b) / a
    return min(max(share, 0.0), 1.0)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def dragged(fx, fy, dx, dy, before, after):  # type: ignore[no-untyped-def]
    """How a sliding tip's force is dragged by the drive d, for `turned`.

    `before`, `after`: the cone's radius at both ends.

    Returns:
        direction of the drive; tan(theta / 2) as a quotient's numerator and denominator, theta
        being the angle from the drive to the force; and the way over the radius (negative: the
        force points along the drive at once).
    """
    size, drive = np.sqrt(fx * fx + fy * fy), np.sqrt(dx * dx + dy * dy)
    per_size, per_drive = 1.0 / size, 1.0 / drive
    ux, uy = (dx * per_drive, dy * per_drive) if drive > 0.0 else (fx * per_size, fy * per_size)
    from_x, from_y = (fx * per_size, fy * per_size) if size > 0.0 else (ux, uy)
    along, across = from_x * ux + from_y * uy, ux * from_y - uy * from_x
    # the way over the logarithmic mean of the radii; near 1 the series of ratio / log(1 + ratio),
    # else the logarithm, with what 1 + ratio rounds away
    ratio = after / before - 1.0
    series = before * (1.0 + ratio * (0.5 - ratio * (1.0 / 12.0 - ratio * (1.0 / 24.0))))
    whole = 1.0 + ratio
    log = logarithm(whole) + (ratio - (whole - 1.0))
    even = abs(ratio) < 1e-3
    way = (drive if even else drive * log) / (series if even else after - before)
    way = way if after > 0.0 and before > 0.0 else -1.0
    # along < 0 beyond a right angle: 1 + along cancels there
    high, low = (across, 1.0 + along) if along > 0.0 else (1.0 - along, across)
    return ux, uy, high, low, way


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def turned(ux, uy, high, low, way):  # type: ignore[no-untyped-def]
    """Direction of a sliding tip's force after the drive: the tractrix. A unit vector."""
    # straight against the drive it stays so
    high *= decayed(max(way, 0.0)) if low != 0.0 else 1.0
    high = high if way >= 0.0 else 0.0
    scale = 1.0 / (low * low + high * high)
    cosine, sine = (low * low - high * high) * scale, 2.0 * high * low * scale
    x, y = cosine * ux - sine * uy, sine * ux + cosine * uy
    return (x, y) if way >= 0.0 else (ux, uy)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def chord(fx, fy, to_x, to_y, ux, uy, after):  # type: ignore[no-untyped-def]
    """Direction of a step's slip: a unit vector.

    Args:
        fx, fy: force when the slip begins, N.
        to_x, to_y: force at the end if the tip did not slip, N.
        ux, uy: direction of the force at the end, from `turned`.
        after: its size there, the cone's radius, N.
    """
    size = np.sqrt(fx * fx + fy * fy)
    per_size = 1.0 / size if size > 0.0 else 0.0
    mean_x, mean_y = ux + fx * per_size, uy + fy * per_size
    # what the slip takes away of the force points along the slip, between the two directions of
    # the force; where rounding or a radius that is only foreseen say otherwise, half-way is right
    x, y = to_x - after * ux, to_y - after * uy
    length = np.sqrt(x * x + y * y)
    between = x * mean_x + y * mean_y > length * (ux * mean_x + uy * mean_y) * _BETWEEN
    x, y = (x, y) if between else (mean_x, mean_y)
    scale = 1.0 / np.sqrt(x * x + y * y)
    return x * scale, y * scale
