"""One step of many tips side by side: those that stay free, stick on or slide on.

A tip's step is a chain of square roots and quotients that each wait for the one before, but tips
do not wait for each other. So every stage here runs over all lanes of a block without a branch,
which lets the processor compute several at once; a lane whose search has ended keeps its values.
What is rare (touching, letting go, being caught) is left to `rigs.scene.tip.tip_step`. Both give
the same bits.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.column import ITERATIONS, bend_step, column, first_bend
from sliplab.rigs.scene.friction import grip_between, knot_at
from sliplab.rigs.scene.rows import (
    AFTER,
    ALONE,
    BEFORE,
    C0,
    C1,
    C2,
    C3,
    DEEP,
    END_BENT,
    END_FORCE_X,
    END_FORCE_Y,
    END_MODE,
    END_NORMAL,
    END_X,
    END_Y,
    GAIN,
    HIGH,
    KNOT,
    LANES,
    LOW,
    PRESSED,
    SEEKS,
    SHARE,
    SLIP,
    SOFT,
    STRETCH,
    TABLE,
    TO_X,
    TO_Y,
    WANTED,
    block_of,
    take_knot,
)
from sliplab.rigs.scene.sliding import is_steady, slows_down
from sliplab.rigs.scene.sliding_lanes import slide_on
from sliplab.rigs.scene.springs import (
    ACROSS,
    ALONG,
    BASE_X,
    BASE_Y,
    BENDING,
    BENT,
    BRANCH_X,
    BRANCH_Y,
    COMPLIANCE,
    EARLIER,
    FORCE_X,
    FORCE_Y,
    FREE,
    GAP,
    INDENTATION,
    LAYOUT_X,
    LAYOUT_Y,
    MODE,
    NORMAL,
    NORMAL_BRANCH,
    PATH,
    PLACE_X,
    PLACE_Y,
    SHORTER,
    SLID_S,
    SLIDING,
    SLIPPED,
    SPEED,
    STUCK,
)
from sliplab.rigs.scene.tip import ROUNDING, tip_step
from sliplab.rigs.scene.turning import raised, slides_on


@njit(cache=True, nogil=True, error_model="numpy")
def respond(flat, field, law, first, count, sensor, plate_y, swerve, h, decay, gain):  # type: ignore[no-untyped-def]
    """Find what becomes of a block's tips in a step; the state stays.

    Args:
        flat: a block (`rigs.scene.rows`); END_MODE to GAIN are written.
        first, count: the block's first tip, and how many it has.
        sensor: x, y, depth (mm) at the end of the step, and the two slopes of depth, (5,).
        plate_y: height of the plate at the end of the step, mm.
        swerve, h, decay, gain: as in `rigs.scene.tip.tip_step`.
    """
    w = block_of(flat)
    if _approach(w, law, sensor[0], sensor[1], sensor[2], sensor[3], sensor[4], plate_y, decay,
                 gain, h) > 0:  # fmt: skip
        for j in range(count):
            if w[WANTED, j] != w[KNOT, j]:
                take_knot(w, field, first + j, j, w[WANTED, j])
    for _ in range(ITERATIONS):
        if _bend(w) == 0:
            break
    slide, alone = _decide(w, law, h, decay, gain, swerve)
    if slide > 0:
        alone += slide_on(w, field, law, first, count, h, swerve, decay, gain)
    if alone > 0:
        for j in range(count):
            if w[END_MODE, j] == ALONE:
                tip_step(w, field, law, first + j, j, h, swerve, decay, gain)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _approach(w, law, x, y, depth, slope_x, slope_y, plate_y, decay, gain, h):  # type: ignore[no-untyped-def]
    """Bases at the end of the step, and first guesses; how many tips need another knot."""
    stale = 0
    soft = law.maxwell * gain + law.damping_s / h
    for j in range(LANES):
        lx, ly = w[TABLE + LAYOUT_X, j], w[TABLE + LAYOUT_Y, j]
        to_x, to_y = x + lx, y + ly - plate_y
        deep = depth + slope_x * lx + slope_y * ly - w[TABLE + GAP, j]
        along, was = w[TABLE + ALONG, j], w[INDENTATION, j]
        was = was if was > 0.0 else 0.0
        pressed = (
            along * deep + w[NORMAL_BRANCH, j] * decay + law.maxwell * along * gain * (deep - was)
        )
        new_x, new_y = to_x - w[PLACE_X, j], to_y - w[PLACE_Y, j]
        stretch = np.sqrt(new_x * new_x + new_y * new_y)
        touches = w[MODE, j] != FREE and deep > 0.0 and pressed > 0.0
        w[END_BENT, j] = first_bend(
            stretch, w[BENT, j], w[TABLE + BENDING, j], w[TABLE + SHORTER, j],
            w[TABLE + COMPLIANCE, j],
        )  # fmt: skip
        w[LOW, j], w[HIGH, j] = 0.0, stretch
        w[TO_X, j], w[TO_Y, j], w[DEEP, j] = to_x, to_y, deep
        w[PRESSED, j], w[SOFT, j], w[STRETCH, j] = pressed, w[TABLE + ACROSS, j] * soft, stretch
        w[SEEKS, j] = 1.0 if touches else 0.0
        wanted = knot_at(w[PATH, j])
        w[WANTED, j] = wanted
        stale += 1 if wanted != w[KNOT, j] else 0
    return stale


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _bend(w):  # type: ignore[no-untyped-def]
    """A step of every tip towards its bend if it sticks; how many have not found it."""
    seek = 0
    for j in range(LANES):
        seeks = w[SEEKS, j] > 0.0
        bent, low, high, found = bend_step(
            w[END_BENT, j], w[LOW, j], w[HIGH, j], w[STRETCH, j], w[TABLE + BENDING, j],
            w[TABLE + SHORTER, j], w[TABLE + COMPLIANCE, j], w[PRESSED, j], w[TABLE + ALONG, j],
        )  # fmt: skip
        w[END_BENT, j] = bent if seeks else w[END_BENT, j]
        w[LOW, j], w[HIGH, j] = low, high
        still = seeks and not found
        w[SEEKS, j] = 1.0 if still else 0.0
        seek += 1 if still else 0
    return seek


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _decide(w, law, h, decay, gain, swerve):  # type: ignore[no-untyped-def]
    """The forces if all tips stick, and which do; how many slide on, and go on alone."""
    slide, alone = 0, 0
    static = 1.0 + law.static_excess
    for j in range(LANES):
        mode, deep = w[MODE, j], w[DEEP, j]
        place_x, place_y = w[PLACE_X, j], w[PLACE_Y, j]
        to_x, to_y = w[TO_X, j], w[TO_Y, j]
        new_x, new_y = to_x - place_x, to_y - place_y
        old_x, old_y = w[BASE_X, j] - place_x, w[BASE_Y, j] - place_y
        branch_x, branch_y = w[BRANCH_X, j] * decay, w[BRANCH_Y, j] * decay
        soft, bent, stretch = w[SOFT, j], w[END_BENT, j], w[STRETCH, j]
        damp = w[TABLE + ACROSS, j] * law.damping_s
        force, normal, _, _ = column(
            bent, w[TABLE + BENDING, j], w[TABLE + SHORTER, j], w[PRESSED, j], w[TABLE + ALONG, j]
        )
        secant = force / stretch if stretch > 0.0 else 0.0
        trial_x = secant * new_x + branch_x + soft * (new_x - old_x)
        trial_y = secant * new_y + branch_y + soft * (new_y - old_y) + damp * swerve
        grip, _ = grip_between(w[PATH, j], w[KNOT, j], w[C0, j], w[C1, j], w[C2, j], w[C3, j])
        from_x, from_y = w[FORCE_X, j], w[FORCE_Y, j]
        before, after = grip * w[NORMAL, j], grip * normal
        keeps_on = mode == SLIDING and slides_on(
            from_x, from_y, trial_x - from_x, trial_y - from_y, before, after, law.strengthening
        )
        limit = after * (1.0 if keeps_on else static)
        size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
        touches = mode != FREE and deep > 0.0 and w[PRESSED, j] > 0.0
        free = (mode != FREE and not touches) or deep <= 0.0
        sticks = touches and size <= limit * ROUNDING
        slows = slows_down(
            w[SLID_S, j], w[SPEED, j], from_x, from_y, new_x - old_x, new_y - old_y, h, law
        )
        slides = touches and keeps_on and not sticks and not slows
        end = SLIDING if slides else ALONE
        end = STUCK if sticks else end
        end = FREE if free else end
        w[END_MODE, j] = end
        w[END_X, j], w[END_Y, j] = to_x if free else place_x, to_y if free else place_y
        w[END_FORCE_X, j] = 0.0 if free else trial_x
        w[END_FORCE_Y, j] = 0.0 if free else trial_y
        w[END_NORMAL, j], w[END_BENT, j] = 0.0 if free else normal, 0.0 if free else bent
        w[SLIP, j], w[SHARE, j], w[GAIN, j] = 0.0, -1.0, gain
        w[BEFORE, j], w[AFTER, j] = raised(from_x, from_y, before, after)
        w[SEEKS, j] = 1.0 if slides else 0.0
        slide += 1 if slides else 0
        alone += 1 if end == ALONE else 0
    return slide, alone


@njit(cache=True, nogil=True, error_model="numpy")
def settle(flat, law, start_s, h, decay):  # type: ignore[no-untyped-def]
    """Take what `respond` found as the state; `start_s`: when the step began, s."""
    w = block_of(flat)
    for j in range(LANES):
        mode, end, deep = w[MODE, j], w[END_MODE, j], w[DEEP, j]
        x, y, to_x, to_y = w[END_X, j], w[END_Y, j], w[TO_X, j], w[TO_Y, j]
        touching, clear = mode == FREE, end == FREE
        along, was = w[TABLE + ALONG, j], w[INDENTATION, j]
        was = was if was > 0.0 else 0.0
        soft = law.maxwell * w[GAIN, j]
        pressed = w[NORMAL_BRANCH, j] * decay + soft * along * (deep - was)
        w[NORMAL_BRANCH, j] = -along * max(deep, 0.0) if clear else pressed
        # a tip that touches does so without stretch
        old_x = 0.0 if touching else w[BASE_X, j] - w[PLACE_X, j]
        old_y = 0.0 if touching else w[BASE_Y, j] - w[PLACE_Y, j]
        soft *= w[TABLE + ACROSS, j]
        branch_x = w[BRANCH_X, j] * decay + soft * (to_x - x - old_x)
        branch_y = w[BRANCH_Y, j] * decay + soft * (to_y - y - old_y)
        w[BRANCH_X, j], w[BRANCH_Y, j] = 0.0 if clear else branch_x, 0.0 if clear else branch_y
        w[INDENTATION, j], w[MODE, j] = deep, end
        w[BASE_X, j], w[BASE_Y, j], w[PLACE_X, j], w[PLACE_Y, j] = to_x, to_y, x, y
        w[FORCE_X, j], w[FORCE_Y, j] = w[END_FORCE_X, j], w[END_FORCE_Y, j]
        w[NORMAL, j], w[BENT, j] = w[END_NORMAL, j], w[END_BENT, j]
        slip, share = w[SLIP, j], w[SHARE, j]
        w[SLIPPED, j] = start_s + share * h if share >= 0.0 else w[SLIPPED, j]
        part = h * (1.0 - max(share, 0.0))
        speed, earlier = slip / part if slip > 0.0 else 0.0, w[SPEED, j]
        # a tip that just let go, or slows down fast, is not as it was a step ago
        steady = slip > 0.0 and share < 0.0 and is_steady(earlier, speed)
        w[EARLIER, j] = earlier if steady and w[SLID_S, j] == h else -1.0
        w[SLID_S, j], w[SPEED, j] = h if steady else 0.0, speed
        w[PATH, j] += slip
