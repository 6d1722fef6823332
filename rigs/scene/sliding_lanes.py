"""Tips that slide on, many side by side: the second half of a step of `rigs.scene.lanes`.

Each stage is a short loop, so that a processor can begin with the next tips while it waits for
the square roots and quotients of these.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.column import column
from rigs.scene.friction import grip_between, knot_at
from rigs.scene.rows import (
    AHEAD,
    ALONE,
    ASKEW,
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
    GRIP,
    GRIP_SLOPE,
    HIGH,
    KNOT,
    LAG,
    LANES,
    LIMIT,
    LOW,
    MISS,
    MISS_SLOPE,
    NEW_NORMAL,
    NEW_STRETCH,
    NORMAL_SLOPE,
    PRESSED,
    QUICK,
    REST_X,
    REST_Y,
    SEEKS,
    SLIP,
    SOFT,
    STRAIGHT,
    STRETCH,
    STRETCH_SLOPE,
    TABLE,
    TO_X,
    TO_Y,
    TOP,
    TURNS,
    UNIT_X,
    UNIT_Y,
    WANTED,
    WAY,
    take_knot,
)
from rigs.scene.sliding import PASSES, foreseen, slid, slide_step, strengthened, stretched
from rigs.scene.springs import (
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
from rigs.scene.turning import dragged, turned


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slide_on(w, field, law, first, count, h, decay):  # type: ignore[no-untyped-def]
    """Let the tips slide whose END_MODE says so.

    Args:
        w: a block (`rigs.scene.rows`) in which `rigs.scene.lanes` has decided.
        first, count: as in `rigs.scene.lanes.respond`.

    Returns:
        how many have not found their bend; their END_MODE becomes ALONE.
    """
    _aim(w, law, decay, h)
    seek = 0
    for _ in range(PASSES):
        if _stretch(w) > 0:
            for j in range(count):
                if w[SEEKS, j] > 0.0 and w[WANTED, j] != w[KNOT, j]:
                    take_knot(w, field, first + j, j, w[WANTED, j])
        seek = _seek(w, law)
        if seek == 0:
            break
    if _arrive(w) > 0:
        for j in range(count):
            if w[END_MODE, j] == SLIDING and w[WANTED, j] != w[KNOT, j]:
                take_knot(w, field, first + j, j, w[WANTED, j])
    _pull(w, law)
    return seek


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _aim(w, law, decay, h):  # type: ignore[no-untyped-def]
    """Directions of sliding tips' forces, and first guesses of their bends."""
    if law.exact_turns:
        for j in range(LANES):
            from_x, from_y = w[FORCE_X, j], w[FORCE_Y, j]
            w[UNIT_X, j], w[UNIT_Y, j], w[TOP, j], w[BOTTOM, j], w[WAY, j] = dragged(
                from_x, from_y, w[END_FORCE_X, j] - from_x, w[END_FORCE_Y, j] - from_y,
                w[BEFORE, j], w[LIMIT, j],
            )  # fmt: skip
        for j in range(LANES):
            w[UNIT_X, j], w[UNIT_Y, j] = turned(
                w[UNIT_X, j], w[UNIT_Y, j], w[TOP, j], w[BOTTOM, j], w[WAY, j]
            )
    else:
        for j in range(LANES):
            trial_x, trial_y = w[END_FORCE_X, j], w[END_FORCE_Y, j]
            size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
            w[UNIT_X, j], w[UNIT_Y, j] = trial_x / size, trial_y / size
    per_s = 1.0 / h
    for j in range(LANES):
        quick, lag, slides = foreseen(h, per_s, w[SLID_S, j], w[SPEED, j], w[EARLIER, j])
        new_x, new_y = w[TO_X, j] - w[PLACE_X, j], w[TO_Y, j] - w[PLACE_Y, j]
        old_x, old_y = w[BASE_X, j] - w[PLACE_X, j], w[BASE_Y, j] - w[PLACE_Y, j]
        w[REST_X, j] = w[SOFT, j] * old_x - w[BRANCH_X, j] * decay
        w[REST_Y, j] = w[SOFT, j] * old_y - w[BRANCH_Y, j] * decay
        moved = (new_x - old_x) * w[UNIT_X, j] + (new_y - old_y) * w[UNIT_Y, j]
        _, _, slope, _ = column(
            w[BENT, j], w[TABLE + BENDING, j], w[TABLE + SHORTER, j], w[PRESSED, j],
            w[TABLE + ALONG, j],
        )  # fmt: skip
        change = (moved - slides) / (1.0 + w[TABLE + COMPLIANCE, j] * slope)
        guess = w[BENT, j] + (change if slides >= 0.0 else 0.0)
        high = w[END_BENT, j]
        bent = min(max(guess, 0.0), high)
        w[END_BENT, j] = bent if w[SEEKS, j] > 0.0 else high
        w[LOW, j], w[HIGH, j] = 0.0, high
        from_x, from_y = w[FORCE_X, j], w[FORCE_Y, j]
        w[LIMIT, j] = np.sqrt(from_x * from_x + from_y * from_y)
        w[QUICK, j], w[LAG, j] = quick, lag


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _stretch(w):  # type: ignore[no-untyped-def]
    """The first part of a step of every sliding tip; how many need another knot."""
    stale = 0
    for j in range(LANES):
        (
            w[MISS, j], w[MISS_SLOPE, j], w[NEW_NORMAL, j], w[NORMAL_SLOPE, j],
            w[NEW_STRETCH, j], w[STRETCH_SLOPE, j], w[AHEAD, j], w[TURNS, j], slip,
            w[STRAIGHT, j], w[ASKEW, j],
        ) = stretched(
            w[END_BENT, j], w[LIMIT, j], w[TO_X, j] - w[PLACE_X, j], w[TO_Y, j] - w[PLACE_Y, j],
            w[UNIT_X, j], w[UNIT_Y, j], w[REST_X, j], w[REST_Y, j], w[SOFT, j], w[PRESSED, j],
            w[TABLE + ALONG, j], w[TABLE + BENDING, j], w[TABLE + SHORTER, j],
            w[TABLE + COMPLIANCE, j],
        )  # fmt: skip
        wanted = knot_at(w[PATH, j] + slip)
        w[SLIP, j], w[WANTED, j] = slip, wanted
        stale += 1 if w[SEEKS, j] > 0.0 and wanted != w[KNOT, j] else 0
    return stale


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _seek(w, law):  # type: ignore[no-untyped-def]
    """The rest of that step; how many tips have not found their bend."""
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
        bent, force, stretch, normal, found = slide_step(
            w[END_BENT, j], w[HIGH, j], w[LIMIT, j], w[MISS, j], w[MISS_SLOPE, j],
            w[NEW_NORMAL, j], w[NORMAL_SLOPE, j], w[NEW_STRETCH, j], w[STRETCH_SLOPE, j],
            w[AHEAD, j], w[TURNS, j], w[STRAIGHT, j], w[ASKEW, j], w[GRIP, j], w[GRIP_SLOPE, j],
        )  # fmt: skip
        w[END_BENT, j] = bent if seeks else w[END_BENT, j]
        w[STRETCH, j] = stretch if seeks else w[STRETCH, j]
        w[LIMIT, j] = force if seeks else w[LIMIT, j]
        w[END_NORMAL, j] = normal if seeks else w[END_NORMAL, j]
        still = seeks and not found
        w[SEEKS, j] = 1.0 if still else 0.0
        seek += 1 if still else 0
    return seek


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _arrive(w):  # type: ignore[no-untyped-def]
    """Places and slips of the tips that slid; how many need another knot."""
    stale = 0
    for j in range(LANES):
        # what was not found is done alone
        end = ALONE if w[SEEKS, j] > 0.0 else w[END_MODE, j]
        slides = end == SLIDING
        w[END_MODE, j] = end
        to_x, to_y = w[TO_X, j], w[TO_Y, j]
        x, y, slip = slid(
            w[STRETCH, j], w[LIMIT, j], to_x - w[PLACE_X, j], to_y - w[PLACE_Y, j],
            w[UNIT_X, j], w[UNIT_Y, j], w[REST_X, j], w[REST_Y, j],
        )  # fmt: skip
        wanted = knot_at(w[PATH, j] + slip)
        w[END_X, j] = to_x - x if slides else w[END_X, j]
        w[END_Y, j] = to_y - y if slides else w[END_Y, j]
        w[SLIP, j] = slip if slides else 0.0
        w[WANTED, j] = wanted
        stale += 1 if slides and wanted != w[KNOT, j] else 0
    return stale


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _pull(w, law):  # type: ignore[no-untyped-def]
    """Forces of the tips that slid: on the cone of the way that is told, to the last bit."""
    for j in range(LANES):
        slides, slip = w[END_MODE, j] == SLIDING, w[SLIP, j]
        grip, _ = grip_between(
            w[PATH, j] + slip, w[KNOT, j], w[C0, j], w[C1, j], w[C2, j], w[C3, j]
        )
        grip, _ = strengthened(grip, 0.0, slip, w[QUICK, j], w[LAG, j], law)
        limit = grip * w[END_NORMAL, j]
        w[END_FORCE_X, j] = limit * w[UNIT_X, j] if slides else w[END_FORCE_X, j]
        w[END_FORCE_Y, j] = limit * w[UNIT_Y, j] if slides else w[END_FORCE_Y, j]
