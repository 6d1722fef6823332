"""The bend of a tip that slides: what its slip leaves of the stretch, with friction by the slip.

One Newton step in three parts, shared by the tip that is computed alone (`rigs.scene.tip`) and by
those computed side by side (`rigs.scene.sliding_lanes`), so that both give the same bits. No
branches, for the latter. Where it does not get there, because friction has a kink at rest,
`slid_surely` does, slowly.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.column import CLOSE, ITERATIONS, column
from rigs.scene.friction import grip_at
from rigs.scene.smooth import logarithm
from rigs.scene.turning import unit

PASSES = 8
"""Newton steps that many tips try side by side; two do while rows are close."""
TRIES = 24
"""Newton steps that one tip tries."""


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def strengthened(grip, slope, slip, quick, lag, law):  # type: ignore[no-untyped-def]
    """A coefficient of friction and its slope over the slip, raised by the speed of sliding.

    The speed at the end of the step is `quick` (1/s) times the slip plus `lag` (mm/s).
    """
    speed = quick * slip + lag
    speed = speed if speed > 0.0 else 0.0
    share = 1.0 / law.weak_mm_s
    whole = 1.0 + speed * share
    more = 1.0 + law.strengthening * logarithm(whole)
    rate = law.strengthening * share * quick / whole if speed > 0.0 else 0.0
    return grip * more, slope * more + grip * rate


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def stretched(  # type: ignore[no-untyped-def]
    bent, force, new_x, new_y, unit_x, unit_y, rest_x, rest_y, soft, pressed, pressing, bending,
    shortening, compliance,
):  # fmt: skip
    """What a bend and a force mean for each other, and the slip that they leave.

    The force turns the stretch, by what relaxes and damps, and so decides on the slip, which
    decides on the friction, that is the force.

    Args:
        bent: the bend, mm.
        force: tangential, N.
        new_x, new_y: of the base from where the tip stood, mm.
        unit_x, unit_y: direction of the force.
        rest_x, rest_y, soft: what relaxation and damping take of it, N, and per stretch, N/mm.
        pressed, pressing, bending, shortening, compliance: as in `column`.

    Returns:
        what the spring pulls more than the force does, N, and its slope over the bend; normal
        force and its slope; stretch, mm, and its slope; share of the force along the stretch;
        how the stretch turns with the force, rad/N; slip, mm, and its shares along and across the
        stretch.
    """
    spring, normal, slope, normal_slope = column(bent, bending, shortening, pressed, pressing)
    stretch, stretch_slope = bent + compliance * spring, 1.0 + compliance * slope
    pull_x, pull_y = force * unit_x + rest_x, force * unit_y + rest_y
    pull = np.sqrt(pull_x * pull_x + pull_y * pull_y)
    pulls = pull > 0.0
    per_pull = 1.0 / pull if pulls else 0.0
    towards_x = pull_x * per_pull if pulls else unit_x
    towards_y = pull_y * per_pull if pulls else unit_y
    ahead = towards_x * unit_x + towards_y * unit_y
    turns = (towards_x * unit_y - towards_y * unit_x) * per_pull
    slip_x, slip_y = new_x - stretch * towards_x, new_y - stretch * towards_y
    slip = np.sqrt(slip_x * slip_x + slip_y * slip_y)
    per_slip = 1.0 / slip if slip > 0.0 else 0.0
    straight = (slip_x * towards_x + slip_y * towards_y) * per_slip
    askew = (slip_y * towards_x - slip_x * towards_y) * per_slip
    return (
        spring + soft * stretch - pull, slope + soft * stretch_slope, normal, normal_slope,
        stretch, stretch_slope, ahead, turns, slip, straight, askew,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slide_step(  # type: ignore[no-untyped-def]
    bent, high, force, miss, miss_slope, normal, normal_slope, stretch, stretch_slope, ahead,
    turns, straight, askew, grip, grip_slope,
):  # fmt: skip
    """One Newton step towards the bend whose slip leaves the force on the friction cone.

    Args:
        high: the most that the bend can be, mm.
        miss to askew: from `stretched`.
        grip, grip_slope: friction at the end of the slip, and its slope over it, 1/mm.

    Returns:
        bend, force, stretch and normal force after it, and whether that is it.
    """
    # force = grip normal, to first order in the changes of force and bend
    off = grip * normal - force
    force_slope = grip * normal_slope - normal * grip_slope * stretch_slope * straight
    own = 1.0 + normal * grip_slope * stretch * askew * turns
    per_own = 1.0 / own if own > 0.1 else 1.0
    miss -= ahead * per_own * off
    steepness = miss_slope - ahead * per_own * force_slope
    after = bent - miss / steepness
    inside = steepness > 0.0 and 0.0 <= after <= high
    after = after if inside else 0.5 * (bent + (0.0 if miss > 0.0 else high))
    change = after - bent
    more = (off + force_slope * change) * per_own
    # the next changes would be of the order of the squares of these: rounding
    found = abs(change) <= CLOSE * after and abs(turns * more) <= CLOSE
    return (
        after, max(force + more, 0.0), stretch + stretch_slope * change,
        normal + normal_slope * change, found,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def _miss(  # type: ignore[no-untyped-def]
    bent, towards_x, towards_y, new_x, new_y, unit_x, unit_y, rest_x, rest_y, soft, pressed,
    pressing, bending, shortening, compliance, field, i, path, quick, lag, law,
):  # fmt: skip
    """What the spring pulls more than friction holds, N; force, N; stretch, mm; normal force."""
    spring, normal, _, _ = column(bent, bending, shortening, pressed, pressing)
    stretch = bent + compliance * spring
    slip_x, slip_y = new_x - stretch * towards_x, new_y - stretch * towards_y
    slip = np.sqrt(slip_x * slip_x + slip_y * slip_y)
    grip, _ = grip_at(field, i, path + slip)
    grip, _ = strengthened(grip, 0.0, slip, quick, lag, law)
    force = grip * normal
    pull_x, pull_y = force * unit_x + rest_x, force * unit_y + rest_y
    pull = np.sqrt(pull_x * pull_x + pull_y * pull_y)
    return spring + soft * stretch - pull, force, stretch, normal


@njit(cache=True, nogil=True, error_model="numpy")
def slid_surely(  # type: ignore[no-untyped-def]
    high, force, new_x, new_y, unit_x, unit_y, rest_x, rest_y, soft, pressed, pressing, bending,
    shortening, compliance, field, i, path, quick, lag, law,
):  # fmt: skip
    """What `slide_step` looks for, by regula falsi for one direction of the stretch after another.

    Returns:
        bend, force, stretch, normal force.
    """
    bent, stretch, normal = high, 0.0, 0.0
    for _ in range(ITERATIONS):
        towards_x, towards_y = unit(force * unit_x + rest_x, force * unit_y + rest_y)
        before = force
        left, right, below, above, side = 0.0, high, 0.0, 0.0, 0
        for _ in range(ITERATIONS):
            known = below < 0.0 < above
            bent = (left * above - right * below) / (above - below) if known else bent
            bent = bent if left < bent < right else 0.5 * (left + right)
            miss, force, stretch, normal = _miss(
                bent, towards_x, towards_y, new_x, new_y, unit_x, unit_y, rest_x, rest_y, soft,
                pressed, pressing, bending, shortening, compliance, field, i, path, quick, lag,
                law,
            )  # fmt: skip
            if miss > 0.0:
                right, above = bent, miss
                below = 0.5 * below if side == 1 else below
                side = 1
            else:
                left, below = bent, miss
                above = 0.5 * above if side == -1 else above
                side = -1
            if abs(miss) <= 1e-15 * force or right - left <= 1e-15 * high:
                break
        if abs(force - before) <= 1e-14 * force:
            break
    return bent, force, stretch, normal


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slid(stretch, force, new_x, new_y, unit_x, unit_y, rest_x, rest_y):  # type: ignore[no-untyped-def]
    """The stretch as a vector, and the slip that it leaves, mm."""
    # a direction that lags behind by a hair would make the way longer, step by step
    towards_x, towards_y = unit(force * unit_x + rest_x, force * unit_y + rest_y)
    x, y = stretch * towards_x, stretch * towards_y
    return x, y, np.sqrt((new_x - x) * (new_x - x) + (new_y - y) * (new_y - y))


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def foreseen(slid_s, per_s, earlier_s, speed, earlier):  # type: ignore[no-untyped-def]
    """Speed at the end of a step from the slip in it and the mean speeds of the steps before.

    A line through two of them, a parabola through three if all took as long. `per_s` is
    1 / `slid_s`.

    Returns:
        quick and lag of `strengthened`, and the slip, mm, if the tip slid on as it did
        (negative: not known).
    """
    known = earlier_s > 0.0
    even = earlier_s == slid_s and earlier >= 0.0
    ahead = slid_s / (slid_s + earlier_s)
    weight, lag = (
        (11.0 / 6.0, earlier / 3.0 - 7.0 / 6.0 * speed) if even else (1.0 + ahead, -ahead * speed)
    )  # fmt: skip
    weight, lag = (weight, lag) if known else (1.0, 0.0)
    slides = (2.0 * speed - earlier) * slid_s if known and even else -1.0
    return weight * per_s, lag, slides
