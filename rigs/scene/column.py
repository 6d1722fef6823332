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
ITERATIONS = 60
CLOSE = 1e-7
"""A change of the bend, over the bend, after which Newton's next one would be rounding."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
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


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def first_bend(stretch, guess, bending, shortening, compliance):  # type: ignore[no-untyped-def]
    """Where the search for a bend begins: its solution, if the papilla is not shortened."""
    straight = stretch / (1.0 + compliance * bending)
    return straight if shortening == 0.0 else min(guess, stretch)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def bend_step(bent, low, high, stretch, bending, shortening, compliance, pressed, pressing):  # type: ignore[no-untyped-def]
    """One guarded Newton step towards the bend at a stretch.

    Returns:
        the bend, the bracket round it, and whether that is it.
    """
    force, _, slope, _ = column(bent, bending, shortening, pressed, pressing)
    miss = bent + compliance * force - stretch
    found = abs(miss) <= 1e-14 * stretch
    low, high = (low, bent) if miss > 0.0 else (bent, high)
    after = bent - miss / (1.0 + compliance * slope)
    after = after if low <= after <= high else 0.5 * (low + high)
    near = abs(after - bent) <= CLOSE * stretch
    return (bent if found else after), low, high, found or near


@njit(cache=True, nogil=True, error_model="numpy")
def bend_for(stretch, guess, bending, shortening, compliance, pressed, pressing):  # type: ignore[no-untyped-def]
    """The bend of a papilla whose tip is `stretch` mm from under its base."""
    low, high = 0.0, stretch
    bent = first_bend(stretch, guess, bending, shortening, compliance)
    for _ in range(ITERATIONS):
        bent, low, high, found = bend_step(
            bent, low, high, stretch, bending, shortening, compliance, pressed, pressing
        )
        if found:
            break
    return bent


@njit(cache=True, nogil=True, error_model="numpy")
def relaxing(h, relaxation_s):  # type: ignore[no-untyped-def]
    """Decay of the relaxing branch over `h` s, and its gain for a linear motion in that time.

    q' = -q / tau + k x' with x' constant gives q+ = q e^(-h/tau) + k tau (1 - e^(-h/tau)) dx / h.
    """
    share = h / relaxation_s
    return np.exp(-share), -np.expm1(-share) / share
