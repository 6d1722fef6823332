"""Tips that slide on, many side by side: the second half of a step of `rigs.scene.lanes`.

Each stage is a short loop, so that a processor can begin with the next tips while it waits for
the square roots and quotients of these.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.friction import grip_between, knot_at
from sliplab.rigs.scene.rows import (
    AFTER,
    AHEAD,
    ALONE,
    ASIDE,
    BEFORE,
    BOTTOM,
    C0,
    C1,
    C2,
    C3,
    END_BENT,
    END_FORCE_X,
    END_FORCE_Y,
    END_MODE,
    END_NORMAL,
    END_X,
    END_Y,
    FAR,
    GRIP,
    GRIP_SLOPE,
    KNOT,
    LAG,
    LANES,
    PRESSED,
    QUICK,
    REST_X,
    REST_Y,
    SEEKS,
    SLIP,
    SOFT_X,
    SOFT_Y,
    TABLE,
    TO_X,
    TO_Y,
    TOP,
    UNIT_X,
    UNIT_Y,
    WANTED,
    WAY,
    take_knot,
)
from sliplab.rigs.scene.sliding import (
    PASSES,
    along_slip,
    begun,
    foreseen,
    onto_cone,
    pulled,
    slide_step,
    strengthened,
)
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
    PATH,
    PLACE_X,
    PLACE_Y,
    SHORTER,
    SLID_S,
    SLIDING,
    SPEED,
)
from sliplab.rigs.scene.turning import chord, dragged, turned


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slide_on(w, field, law, first, count, h, swerve, decay, gain):  # type: ignore[no-untyped-def]
    """Let the tips slide whose END_MODE says so.

    Args:
        w: a block (`rigs.scene.rows`) in which `rigs.scene.lanes` has decided.
        first, count, swerve, h, decay, gain: as in `rigs.scene.lanes.respond`.

    Returns:
        how many must be computed alone; their END_MODE is ALONE.
    """
    _aim(w, law)
    _begin(w, law, field.shape[1] > 1, h, swerve, decay, gain)
    for _ in range(PASSES):
        if _look(w) > 0:
            for j in range(count):
                if w[SEEKS, j] > 0.0 and w[WANTED, j] != w[KNOT, j]:
                    take_knot(w, field, first + j, j, w[WANTED, j])
        if _seek(w, law) == 0:
            break
    stale, alone = _arrive(w)
    if stale > 0:
        for j in range(count):
            if w[END_MODE, j] == SLIDING and w[WANTED, j] != w[KNOT, j]:
                take_knot(w, field, first + j, j, w[WANTED, j])
    _pull(w, law)
    return alone


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _aim(w, law):  # type: ignore[no-untyped-def]
    """Directions of the slips of sliding tips."""
    if law.exact_turns:
        for j in range(LANES):
            from_x, from_y = w[FORCE_X, j], w[FORCE_Y, j]
            w[UNIT_X, j], w[UNIT_Y, j], w[TOP, j], w[BOTTOM, j], w[WAY, j] = dragged(
                from_x, from_y, w[END_FORCE_X, j] - from_x, w[END_FORCE_Y, j] - from_y,
                w[BEFORE, j], w[AFTER, j],
            )  # fmt: skip
        for j in range(LANES):
            unit_x, unit_y = turned(w[UNIT_X, j], w[UNIT_Y, j], w[TOP, j], w[BOTTOM, j], w[WAY, j])
            w[UNIT_X, j], w[UNIT_Y, j] = chord(
                w[FORCE_X, j], w[FORCE_Y, j], w[END_FORCE_X, j], w[END_FORCE_Y, j], unit_x, unit_y,
                w[AFTER, j],
            )  # fmt: skip
    else:
        for j in range(LANES):
            trial_x, trial_y = w[END_FORCE_X, j], w[END_FORCE_Y, j]
            size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
            w[UNIT_X, j], w[UNIT_Y, j] = trial_x / size, trial_y / size


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _begin(w, law, rough, h, swerve, decay, gain):  # type: ignore[no-untyped-def]
    """Set up the arrays of the search, and where it begins."""
    per_s = 1.0 / h
    for j in range(LANES):
        quick, lag, slides = foreseen(h, per_s, w[SLID_S, j], w[SPEED, j], w[EARLIER, j])
        new_x, new_y = w[TO_X, j] - w[PLACE_X, j], w[TO_Y, j] - w[PLACE_Y, j]
        old_x, old_y = w[BASE_X, j] - w[PLACE_X, j], w[BASE_Y, j] - w[PLACE_Y, j]
        unit_x, unit_y = w[UNIT_X, j], w[UNIT_Y, j]
        (
            w[AHEAD, j], w[ASIDE, j], w[REST_X, j], w[REST_Y, j], w[SOFT_X, j], w[SOFT_Y, j],
        ) = along_slip(
            new_x, new_y, old_x, old_y, w[BRANCH_X, j] * decay, w[BRANCH_Y, j] * decay,
            w[TABLE + ACROSS, j] * law.maxwell * gain, w[TABLE + ACROSS, j] * law.damping_s, per_s,
            swerve, unit_x, unit_y, quick, lag,
        )  # fmt: skip
        slip, bent, w[FAR, j] = begun(
            new_x - old_x, new_y - old_y, unit_x, unit_y, slides, w[BENT, j],
            w[TABLE + BENDING, j], w[TABLE + SHORTER, j], w[TABLE + COMPLIANCE, j], w[PRESSED, j],
            w[TABLE + ALONG, j], rough,
        )  # fmt: skip
        seeks = w[SEEKS, j] > 0.0
        w[SLIP, j] = slip if seeks else 0.0
        w[END_BENT, j] = bent if seeks else w[END_BENT, j]
        w[QUICK, j], w[LAG, j] = quick, lag


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _look(w):  # type: ignore[no-untyped-def]
    """Find the knots behind which the slips end; how many tips need another one."""
    stale = 0
    for j in range(LANES):
        wanted = knot_at(w[PATH, j] + w[SLIP, j])
        w[WANTED, j] = wanted
        stale += 1 if w[SEEKS, j] > 0.0 and wanted != w[KNOT, j] else 0
    return stale


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _seek(w, law):  # type: ignore[no-untyped-def]
    """A step of every tip towards its slip; how many go on seeking."""
    seek = 0
    for j in range(LANES):
        slip = w[SLIP, j]
        grip, grip_slope = grip_between(
            w[PATH, j] + slip, w[KNOT, j], w[C0, j], w[C1, j], w[C2, j], w[C3, j]
        )
        w[GRIP, j], w[GRIP_SLOPE, j] = strengthened(
            grip, grip_slope, slip, w[QUICK, j], w[LAG, j], law
        )
    for j in range(LANES):
        seeks = w[SEEKS, j] > 0.0
        slip, bent, found, hopeful, _ = slide_step(
            w[SLIP, j], w[END_BENT, j], w[AHEAD, j], w[ASIDE, j], w[REST_X, j], w[REST_Y, j],
            w[SOFT_X, j], w[SOFT_Y, j], w[PRESSED, j], w[TABLE + ALONG, j], w[TABLE + BENDING, j],
            w[TABLE + SHORTER, j], w[TABLE + COMPLIANCE, j], w[GRIP, j], w[GRIP_SLOPE, j],
            w[QUICK, j], law.weak_mm_s,
        )  # fmt: skip
        w[SLIP, j] = slip if seeks else w[SLIP, j]
        w[END_BENT, j] = bent if seeks else w[END_BENT, j]
        gone = seeks and not hopeful
        still = seeks and hopeful and not found
        w[END_MODE, j] = ALONE if gone else w[END_MODE, j]
        w[SEEKS, j] = 1.0 if still else 0.0
        seek += 1 if still else 0
    return seek


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _arrive(w):  # type: ignore[no-untyped-def]
    """Places of the tips that slid; how many need another knot, and how many are done alone."""
    stale, alone = 0, 0
    for j in range(LANES):
        # what was not found, or is not believed, is done alone
        slip, end = w[SLIP, j], w[END_MODE, j]
        doubted = end == SLIDING and (w[SEEKS, j] > 0.0 or slip > w[FAR, j])
        end = ALONE if doubted else end
        slides = end == SLIDING
        w[END_MODE, j] = end
        alone += 1 if end == ALONE else 0
        wanted = knot_at(w[PATH, j] + slip)
        w[END_X, j] = w[PLACE_X, j] + slip * w[UNIT_X, j] if slides else w[END_X, j]
        w[END_Y, j] = w[PLACE_Y, j] + slip * w[UNIT_Y, j] if slides else w[END_Y, j]
        w[SLIP, j] = slip if slides else 0.0
        w[WANTED, j] = wanted
        stale += 1 if slides and wanted != w[KNOT, j] else 0
    return stale, alone


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _pull(w, law):  # type: ignore[no-untyped-def]
    """Forces of the tips that slid: on the cone of the way that is told, to the last bit."""
    for j in range(LANES):
        slides, slip = w[END_MODE, j] == SLIDING, w[SLIP, j]
        force_x, force_y, normal = pulled(
            slip, w[END_BENT, j], w[AHEAD, j], w[ASIDE, j], w[REST_X, j], w[REST_Y, j],
            w[SOFT_X, j], w[SOFT_Y, j], w[PRESSED, j], w[TABLE + ALONG, j], w[TABLE + BENDING, j],
            w[TABLE + SHORTER, j],
        )  # fmt: skip
        grip, _ = grip_between(
            w[PATH, j] + slip, w[KNOT, j], w[C0, j], w[C1, j], w[C2, j], w[C3, j]
        )
        grip, _ = strengthened(grip, 0.0, slip, w[QUICK, j], w[LAG, j], law)
        x, y = onto_cone(force_x, force_y, w[UNIT_X, j], w[UNIT_Y, j], grip * normal)
        w[END_FORCE_X, j] = x if slides else w[END_FORCE_X, j]
        w[END_FORCE_Y, j] = y if slides else w[END_FORCE_Y, j]
        w[END_NORMAL, j] = normal if slides else w[END_NORMAL, j]
