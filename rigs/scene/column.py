"""One papilla as a bent and compressed column on a soft base: its forces, and its relaxation.

Large deflection comes from one potential, so that it cannot create energy: with the bend b, the
papilla is compressed by c = depth - 0.6 b^2 / h, and N = k_n c, T = b (k_b - 1.2 N / h). The
second term is the softening of an axially loaded column, which buckles at 10 E I / h^2 (exact:
pi^2 E I / h^2); the stiffness left is clamped at 5 % of k_b.
"""

from __future__ import annotations

import numpy as np
from numba import njit

_LEAST_STIFFNESS = 0.05
_ITERATIONS = 60
CLOSE = 1e-7
"""A change of the bend, over the bend, after which Newton's next one would be rounding."""


@njit(cache=True, nogil=True, error_model="numpy")
def column(bent, bending, shortening, pressed, pressing):  # type: ignore[no-untyped-def]
    """Tangential and normal force of a bent column, and their slopes over the bend.

    N = pressed - pressing * shortening * bent^2, not negative.
    """
    loss = pressing * shortening * bent
    normal = pressed - loss * bent
    normal_slope = -2.0 * loss
    if normal <= 0.0:
        normal, normal_slope = 0.0, 0.0
    stiffness = bending - 2.0 * shortening * normal
    slope = stiffness - 2.0 * shortening * bent * normal_slope
    if stiffness < _LEAST_STIFFNESS * bending:
        stiffness = slope = _LEAST_STIFFNESS * bending
    return stiffness * bent, normal, slope, normal_slope


@njit(cache=True, nogil=True, error_model="numpy")
def bend_for(stretch, guess, bending, shortening, compliance, pressed, pressing):  # type: ignore[no-untyped-def]
    """The bend of a papilla whose tip is `stretch` mm from under its base."""
    if shortening == 0.0:
        return stretch / (1.0 + compliance * bending)
    low, high = 0.0, stretch
    bent = min(guess, stretch)
    for _ in range(_ITERATIONS):
        force, _, slope, _ = column(bent, bending, shortening, pressed, pressing)
        miss = bent + compliance * force - stretch
        if abs(miss) <= 1e-14 * stretch:
            return bent
        if miss > 0.0:
            high = bent
        else:
            low = bent
        change = -miss / (1.0 + compliance * slope)
        if not low <= bent + change <= high:
            change = 0.5 * (low + high) - bent
        bent += change
        if abs(change) <= CLOSE * stretch:
            return bent
    return bent


@njit(cache=True, nogil=True, error_model="numpy")
def relaxing(h, relaxation_s):  # type: ignore[no-untyped-def]
    """Decay of the relaxing branch over `h` s, and its gain for a linear motion in that time.

    q' = -q / tau + k x' with x' constant gives q+ = q e^(-h/tau) + k tau (1 - e^(-h/tau)) dx / h.
    """
    share = h / relaxation_s
    return np.exp(-share), -np.expm1(-share) / share
