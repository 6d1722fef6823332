"""Friction that varies along the path of each tip: what keeps steady sliding from being silent.

With one constant coefficient a sliding papilla pulls with a constant force and its marker stands
still in the image, exactly as if it stuck. Real surfaces are not like that. The field is smooth
(C1 between its knots), so that forces, marker paths and event times stay smooth too, and the
contact solver's Newton steps have a true slope.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numba import njit

from sliplab.rigs.scene.randomness import generator
from sliplab.rigs.scene.skin import Skin

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
def _smoothed(white, kernel, mean, variation):  # type: ignore[no-untyped-def]
    """Rows round which noise is folded with a kernel; term by term: the same bits everywhere."""
    rows, count = white.shape
    reach = kernel.shape[0] // 2
    padded, smooth = np.empty(count + 2 * reach), np.empty(count)
    knots = np.empty((rows, count))
    for i in range(rows):
        padded[:reach], padded[reach + count :] = white[i, count - reach :], white[i, :reach]
        padded[reach : reach + count] = white[i]
        smooth[:] = 0.0
        for shift in range(kernel.shape[0]):
            weight = kernel[shift]
            for k in range(count):
                smooth[k] += weight * padded[k + shift]
        for k in range(count):
            rough = mean[i] * (1.0 + variation * smooth[k])
            knots[i, k] = max(rough, LEAST_SHARE * mean[i])
    return knots


@njit(cache=True, nogil=True, error_model="numpy")
def friction_field(knots):  # type: ignore[no-untyped-def]
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
def knot_at(path_mm):  # type: ignore[no-untyped-def]
    """The last knot before a place on the path, counted on without end, as a float."""
    return np.floor(path_mm * (1.0 / KNOT_MM))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def grip_between(path_mm, knot, c0, c1, c2, c3):  # type: ignore[no-untyped-def]
    """Coefficient on a path behind a knot whose cubic is c0 to c3, and its slope, 1/mm."""
    s = path_mm * (1.0 / KNOT_MM) - knot
    grip = c0 + s * (c1 + s * (c2 + s * c3))
    return grip, (c1 + s * (2.0 * c2 + 3.0 * s * c3)) * (1.0 / KNOT_MM)


@njit(cache=True, nogil=True, error_model="numpy")
def grip_at(field, i, path_mm):  # type: ignore[no-untyped-def]
    """Coefficient of tip `i` after it slid `path_mm`, and its slope along the path, 1/mm."""
    knot = knot_at(path_mm)
    c0, c1, c2, c3 = cubic_at(field, i, knot)
    return grip_between(path_mm, knot, c0, c1, c2, c3)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def cubic_at(field, i, knot):  # type: ignore[no-untyped-def]
    """Coefficients c0 to c3 of tip `i` behind a knot."""
    k = int(knot) & (field.shape[1] - 1)  # a power of two
    return field[i, k, 0], field[i, k, 1], field[i, k, 2], field[i, k, 3]
