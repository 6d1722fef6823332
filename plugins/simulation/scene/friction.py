"""Friction: the coefficient along the path of each tip, and the cone that it makes of the force.

With one constant coefficient a sliding papilla pulls with a constant force and its marker rests in
the image, exactly as if it stuck. Real surfaces are not like that. The field is smooth
(C1 between its knots), so that forces, marker paths and event times stay smooth too, and the
contact solver's Newton steps have a true slope.

Where the direction turns, a tip is dragged behind its base on a line of the cone's radius: a
tractrix, tan(theta/2) = tan(theta0/2) exp(-s / rho). That is exact for linear springs also while
the radius grows or shrinks linearly, rho being then its logarithmic mean. A step of the solver
takes from it only the direction of the step's slip, which lies between those of the force at both
ends: an error of second order there is one of third order in the tip's place.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene.branchless import exp_minus, logarithm
from sliplab.plugins.simulation.scene.randomness import generator
from sliplab.plugins.simulation.scene.skin import Skin
from sliplab.storage.kernels import njit

F64 = npt.NDArray[np.float64]

KNOT_MM = 0.1
KNOTS = 256
LEAST_SHARE = 0.2
"""No knot lies below this share of the mean."""


def friction_knots(
    skin: Skin, kinetic: float, variation: float, correlation_mm: float, seed: int
) -> F64:
    """Kinetic coefficient at knots along each tip's path, Gaussian, shape (n, knots).

    Its autocorrelation over a distance d is exp(-(d / correlation_mm)^2), and it repeats after
    25.6 mm. Without variation there is one knot only.

    Args:
        kinetic: mean coefficient of a papilla without scatter.
        variation: standard deviation over mean.
        seed: the trial's.
    """
    mean = (kinetic * skin.friction_factor)[:, None]
    if variation == 0.0:
        return np.ascontiguousarray(mean.astype(np.float64))
    white = generator(seed, "friction").standard_normal((len(skin), KNOTS))
    knots: F64 = _smoothed(white, _kernel(correlation_mm), mean[:, 0], variation)
    return knots


@lru_cache(maxsize=16)
def _kernel(correlation_mm: float) -> F64:
    """Weights that make white noise correlated, (2 reach + 1,)."""
    reach = min(int(3.0 * correlation_mm / KNOT_MM), KNOTS // 2 - 1)
    away = np.arange(-reach, reach + 1) * KNOT_MM
    kernel: F64 = np.exp(-2.0 * (away / correlation_mm) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))
    kernel.flags.writeable = False
    return kernel


@njit(cache=True, nogil=True, error_model="numpy")
def _smoothed(white: F64, kernel: F64, mean: F64, variation: float) -> F64:
    """Rows round which noise is folded with a kernel; term by term: the same bits everywhere."""
    rows, count = white.shape
    reach = kernel.shape[0] // 2
    padded, smooth = np.empty(count + 2 * reach), np.empty(count)
    knots = np.empty((rows, count))
    for i in range(rows):
        for k in range(reach):
            padded[k], padded[reach + count + k] = white[i, count - reach + k], white[i, k]
        for k in range(count):
            padded[reach + k], smooth[k] = white[i, k], 0.0
        for shift in range(kernel.shape[0]):
            weight = kernel[shift]
            for k in range(count):
                smooth[k] += weight * padded[k + shift]
        for k in range(count):
            rough = mean[i] * (1.0 + variation * smooth[k])
            knots[i, k] = max(rough, LEAST_SHARE * mean[i])
    return knots


@njit(cache=True, nogil=True, error_model="numpy")
def friction_field(knots: F64) -> F64:
    """Cubics through periodic knots with central slopes (Catmull-Rom), shape (n, knots, 4).

    Between knot k and the next the coefficient is c0 + s (c1 + s (c2 + s c3)), s from 0 to 1.
    """
    rows, count = knots.shape
    last = count - 1  # count is a power of two
    field = np.empty((rows, count, 4))
    for i in range(rows):
        for k in range(count):
            here, after = knots[i, k], knots[i, (k + 1) & last]
            slope = 0.5 * (after - knots[i, (k - 1) & last])
            slope_after = 0.5 * (knots[i, (k + 2) & last] - here)
            rise = after - here
            field[i, k, 0], field[i, k, 1] = here, slope
            field[i, k, 2] = 3.0 * rise - 2.0 * slope - slope_after
            field[i, k, 3] = slope + slope_after - 2.0 * rise
    return field


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def knot_at(path_mm: float) -> float:
    """The last knot before a place on the path, counted on without end, as a float."""
    return np.floor(path_mm * (1.0 / KNOT_MM))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def grip_between(
    path_mm: float, knot: float, c0: float, c1: float, c2: float, c3: float
) -> tuple[float, float]:
    """Coefficient on a path behind a knot whose cubic is c0 to c3, and its slope, 1/mm."""
    s = path_mm * (1.0 / KNOT_MM) - knot
    grip = c0 + s * (c1 + s * (c2 + s * c3))
    return grip, (c1 + s * (2.0 * c2 + 3.0 * s * c3)) * (1.0 / KNOT_MM)


@njit(cache=True, nogil=True, error_model="numpy")
def grip_at(field: F64, i: int, path_mm: float) -> tuple[float, float]:
    """Coefficient of tip `i` after it slid `path_mm`, and its slope along the path, 1/mm."""
    knot = knot_at(path_mm)
    c0, c1, c2, c3 = cubic_at(field, i, knot)
    return grip_between(path_mm, knot, c0, c1, c2, c3)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def cubic_at(field: F64, i: int, knot: float) -> tuple[float, float, float, float]:
    """Coefficients c0 to c3 of tip `i` behind a knot."""
    k = int(knot) & (field.shape[1] - 1)  # a power of two
    return field[i, k, 0], field[i, k, 1], field[i, k, 2], field[i, k, 3]


@njit(cache=True, nogil=True, error_model="numpy")
def spot_factor(x_mm: float, y_mm: float, spots: F64) -> float:
    """Factor of friction at a place of the plate; `spots` as in `scene.springs.Springs`."""
    factor = 1.0
    for k in range(spots.shape[0]):
        dx, dy, radius = x_mm - spots[k, 0], y_mm - spots[k, 1], spots[k, 2]
        if dx * dx + dy * dy <= radius * radius:
            factor *= spots[k, 3]
    return factor


_BETWEEN = 1.0 - 1e-9


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def keeps_sliding(
    fx: float, fy: float, dx: float, dy: float, start: float, end: float, strengthening: float
) -> bool:
    """Return whether the force f + s d of a sliding tip stays outside its cone and ends outside.

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
def raised_cone(fx: float, fy: float, before: float, after: float) -> tuple[float, float]:
    """Radii of a cone at both ends of a step, made as large as the force is that lies on it.

    The speed of sliding raises friction, by the same ratio at both ends.
    """
    size = np.sqrt(fx * fx + fy * fy)
    return size, after * (size / before) if before > 0.0 else after


@njit(cache=True, nogil=True, error_model="numpy")
def leaves_cone_at(fx: float, fy: float, dx: float, dy: float, start: float, end: float) -> float:
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
def tractrix(
    fx: float, fy: float, dx: float, dy: float, before: float, after: float
) -> tuple[float, float, float, float, float]:
    """Set up the tractrix on which the drive d drags a sliding tip's force, for `tractrix_end`.

    `before`, `after`: the cone's radius at both ends.

    Returns:
        direction of the drive; tan(theta / 2) as a quotient's numerator and denominator, theta
        being the angle from the drive to the force; and the arc over the radius (negative: the
        force points along the drive at once).
    """
    size, drive = np.sqrt(fx * fx + fy * fy), np.sqrt(dx * dx + dy * dy)
    per_size, per_drive = 1.0 / size, 1.0 / drive
    ux, uy = (dx * per_drive, dy * per_drive) if drive > 0.0 else (fx * per_size, fy * per_size)
    from_x, from_y = (fx * per_size, fy * per_size) if size > 0.0 else (ux, uy)
    along, across = from_x * ux + from_y * uy, ux * from_y - uy * from_x
    # the arc over the logarithmic mean of the radii; near 1 the series of ratio / log(1 + ratio),
    # else the logarithm, with what 1 + ratio rounds away
    ratio = after / before - 1.0
    series = before * (1.0 + ratio * (0.5 - ratio * (1.0 / 12.0 - ratio * (1.0 / 24.0))))
    whole = 1.0 + ratio
    log = logarithm(whole) + (ratio - (whole - 1.0))
    even = abs(ratio) < 1e-3
    arc = (drive if even else drive * log) / (series if even else after - before)
    arc = arc if after > 0.0 and before > 0.0 else -1.0
    # along < 0 beyond a right angle: 1 + along cancels there
    high, low = (across, 1.0 + along) if along > 0.0 else (1.0 - along, across)
    return ux, uy, high, low, arc


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def tractrix_end(ux: float, uy: float, high: float, low: float, arc: float) -> tuple[float, float]:
    """Direction of a sliding tip's force after the drive: the tractrix. A unit vector."""
    # exactly against the drive, the force keeps its direction
    high *= exp_minus(max(arc, 0.0)) if low != 0.0 else 1.0
    high = high if arc >= 0.0 else 0.0
    scale = 1.0 / (low * low + high * high)
    cosine, sine = (low * low - high * high) * scale, 2.0 * high * low * scale
    x, y = cosine * ux - sine * uy, sine * ux + cosine * uy
    return (x, y) if arc >= 0.0 else (ux, uy)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slip_direction(
    fx: float, fy: float, to_x: float, to_y: float, ux: float, uy: float, after: float
) -> tuple[float, float]:
    """Direction of a step's slip: a unit vector.

    Args:
        fx, fy: force when the slip begins, N.
        to_x, to_y: force at the end if the tip did not slip, N.
        ux, uy: direction of the force at the end, from `tractrix_end`.
        after: its size there, the cone's radius, N.
    """
    size = np.sqrt(fx * fx + fy * fy)
    per_size = 1.0 / size if size > 0.0 else 0.0
    mean_x, mean_y = ux + fx * per_size, uy + fy * per_size
    # what the slip takes away of the force points along the slip, between the two directions of
    # the force; where rounding or a predicted radius say otherwise, the middle is right
    x, y = to_x - after * ux, to_y - after * uy
    length = np.sqrt(x * x + y * y)
    between = x * mean_x + y * mean_y > length * (ux * mean_x + uy * mean_y) * _BETWEEN
    x, y = (x, y) if between else (mean_x, mean_y)
    square = x * x + y * y
    # a cone that vanishes lets the force reverse at once: then there is no middle
    x, y, square = (x, y, square) if square > 0.0 else (ux, uy, 1.0)
    scale = 1.0 / np.sqrt(square)
    return x * scale, y * scale
