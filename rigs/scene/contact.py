"""What becomes of one tip in one step, whatever happens to it: touching, sticking, slipping.

A spring in series with a Coulomb slider is the least that shows incipient slip: tips with little
normal force let go first, so slip runs from the outer layer to the centre by itself. The update
is a return mapping (Simo and Hughes, Computational Inelasticity, 1998, ch. 1): assume that the
tip sticks; if its force left the friction cone, find the slip that puts it back onto the cone.
That is stable at any step and stiffness, does not creep, and is exact on straight paths.

Columns are in `rigs.scene.slip`, turns in `rigs.scene.friction`, the slip in
`rigs.scene.slip`. This is the law in full; `rigs.scene.contact` has its two frequent cases for
many tips at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.friction import (
    chord,
    dragged,
    grip_at,
    grip_between,
    knot_at,
    leaves_at,
    raised,
    slides_on,
    turned,
)
from sliplab.rigs.scene.slip import (
    ITERATIONS,
    PASSES,
    along_slip,
    begun,
    bend_for,
    bend_step,
    column,
    first_bend,
    foreseen,
    given_way,
    is_steady,
    onto_cone,
    pulled,
    relaxed_speed,
    relaxing,
    slid_surely,
    slide_step,
    slows_down,
    strengthened,
)
from sliplab.rigs.scene.springs import (
    ACROSS,
    AFTER,
    AHEAD,
    ALONE,
    ALONG,
    ASIDE,
    BASE_X,
    BASE_Y,
    BEFORE,
    BENDING,
    BENT,
    BOTTOM,
    BRANCH_X,
    BRANCH_Y,
    C0,
    C1,
    C2,
    C3,
    COMPLIANCE,
    DEEP,
    EARLIER,
    END_BENT,
    END_FORCE_X,
    END_FORCE_Y,
    END_MODE,
    END_NORMAL,
    END_X,
    END_Y,
    FAR,
    FORCE_X,
    FORCE_Y,
    FREE,
    GAIN,
    GAP,
    GRIP,
    GRIP_SLOPE,
    HIGH,
    INDENTATION,
    KICK,
    KNOT,
    LAG,
    LANES,
    LAYOUT_X,
    LAYOUT_Y,
    LOW,
    MODE,
    NORMAL,
    NORMAL_BRANCH,
    PATH,
    PLACE_X,
    PLACE_Y,
    PRESSED,
    QUICK,
    REST_X,
    REST_Y,
    SEEKS,
    SHARE,
    SHORTER,
    SLID_S,
    SLIDING,
    SLIP,
    SLIPPED,
    SOFT,
    SOFT_X,
    SOFT_Y,
    SPEED,
    STRETCH,
    STUCK,
    TABLE,
    TO_X,
    TO_Y,
    TOP,
    UNIT_X,
    UNIT_Y,
    WANTED,
    WAY,
    block_of,
    gather,
    spread,
    take_knot,
)

ROUNDING = 1.0 + 1e-13
"""A force this little over its limit is rounding, not slip: a tip at rest stays to the bit."""


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(share, w, law, j, limit, new_x, new_y, h, swerve):  # type: ignore[no-untyped-def]
    """Force less `limit` times normal force of a tip that has stuck up to a share of a step, N."""
    decay, gain = relaxing(max(share * h, 1e-12), law.relaxation_s)
    old_x = w[BASE_X, j] - w[PLACE_X, j]
    old_y = w[BASE_Y, j] - w[PLACE_Y, j]
    move_x, move_y = share * (new_x - old_x), share * (new_y - old_y)
    move_y -= swerve * h * share * (1.0 - share)
    x, y = old_x + move_x, old_y + move_y
    along, was = w[TABLE + ALONG, j], w[INDENTATION, j]
    bending, shortening = w[TABLE + BENDING, j], w[TABLE + SHORTER, j]
    sunk = share * (w[DEEP, j] - was)
    pressed = (
        along * (was + sunk) + w[NORMAL_BRANCH, j] * decay + law.maxwell * along * gain * sunk
    )  # fmt: skip
    stretch = np.sqrt(x * x + y * y)
    bent = bend_for(
        stretch, w[BENT, j], bending, shortening, w[TABLE + COMPLIANCE, j], pressed, along
    )
    force, normal, _, _ = column(bent, bending, shortening, pressed, along)
    secant = force / stretch if stretch > 0.0 else 0.0
    soft, damp = w[TABLE + ACROSS, j] * law.maxwell * gain, w[TABLE + ACROSS, j] * law.damping_s
    rate_x, rate_y = (new_x - old_x) / h, (new_y - old_y) / h + swerve * (2.0 * share - 1.0)
    fx = secant * x + w[BRANCH_X, j] * decay + soft * move_x + damp * rate_x
    fy = secant * y + w[BRANCH_Y, j] * decay + soft * move_y + damp * rate_y
    return np.sqrt(fx * fx + fy * fy) - limit * normal


@njit(cache=True, nogil=True, error_model="numpy")
def _lets_go_at(guess, w, law, j, limit, new_x, new_y, h, swerve):  # type: ignore[no-untyped-def]
    """Share of a step at which a stuck tip's force meets its cone: a root of the law itself.

    While a tip sticks its force is a known function of time, relaxation included, so that the
    slip is located exactly in steps of any length (regula falsi, Illinois).
    """
    low, high = 0.0, 1.0
    below = _excess(low, w, law, j, limit, new_x, new_y, h, swerve)
    above = _excess(high, w, law, j, limit, new_x, new_y, h, swerve)
    if below >= 0.0 or above <= 0.0:
        return guess
    share, side = guess, 0
    for _ in range(ITERATIONS):
        if not low < share < high:
            share = 0.5 * (low + high)
        miss = _excess(share, w, law, j, limit, new_x, new_y, h, swerve)
        if miss > 0.0:
            high, above = share, miss
            below = 0.5 * below if side == 1 else below
            side = 1
        else:
            low, below = share, miss
            above = 0.5 * above if side == -1 else above
            side = -1
        if high - low < 1e-12 or abs(miss) < 1e-16:
            break
        share = (low * above - high * below) / (above - below)
    return share


@njit(cache=True, nogil=True, error_model="numpy")
def _end(w, j, mode, x, y, force_x, force_y, normal, bent, slip, share, gain):  # type: ignore[no-untyped-def]
    w[END_MODE, j], w[END_X, j], w[END_Y, j] = mode, x, y
    w[END_FORCE_X, j], w[END_FORCE_Y, j], w[END_NORMAL, j] = force_x, force_y, normal
    w[END_BENT, j], w[SLIP, j], w[SHARE, j], w[GAIN, j] = bent, slip, share, gain


@njit(cache=True, nogil=True, error_model="numpy")
def tip_step(w, field, law, i, j, h, swerve, decay, gain):  # type: ignore[no-untyped-def]
    """Move tip `i` in lane `j` after its base moved within `h` seconds.

    The base moves linearly, but for `swerve`: its speed along y at the end of the step over its
    mean one, mm/s, changing linearly. `decay` and `gain` are the relaxing branch's exact factors
    for linear motion over `h`. What is read: the state, TO_X, TO_Y and DEEP. What is written:
    END_MODE to GAIN, that is mode,
    place, force, normal force, bend, slip (mm), the share of the step at which the tip went
    from stick to slip (negative if it did not), and the gain since it touched.
    """
    base_x, base_y, deep = w[TO_X, j], w[TO_Y, j], w[DEEP, j]
    along, bending = w[TABLE + ALONG, j], w[TABLE + BENDING, j]
    shortening, compliance = w[TABLE + SHORTER, j], w[TABLE + COMPLIANCE, j]
    maxwell = law.maxwell
    was, touched = w[INDENTATION, j], 0.0
    if w[MODE, j] == FREE and deep > 0.0:
        touched = was / (was - deep) if was < 0.0 else 1.0
        if was < 0.0:
            gain = relaxing((1.0 - touched) * h, law.relaxation_s)[1]
    pressed = (
        along * deep + w[NORMAL_BRANCH, j] * decay
        + maxwell * along * gain * (deep - (was if was > 0.0 else 0.0))
    )  # fmt: skip
    if deep <= 0.0 or pressed <= 0.0:
        # clear of the plate, or the skin comes back more slowly than the sensor
        _end(w, j, FREE, base_x, base_y, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0, gain)
        return
    mode, place_x, place_y = w[MODE, j], w[PLACE_X, j], w[PLACE_Y, j]
    old_x, old_y = w[BASE_X, j] - place_x, w[BASE_Y, j] - place_y
    if mode == FREE:
        # the tip stands under its base when it touches, on the way there in this step
        place_x = w[BASE_X, j] + touched * (base_x - w[BASE_X, j]) if was < 0.0 else base_x
        place_y = w[BASE_Y, j] + touched * (base_y - w[BASE_Y, j]) if was < 0.0 else base_y
        old_x, old_y = 0.0, 0.0
    new_x, new_y = base_x - place_x, base_y - place_y
    branch_x, branch_y = w[BRANCH_X, j] * decay, w[BRANCH_Y, j] * decay
    soft = w[TABLE + ACROSS, j] * (maxwell * gain + law.damping_s / h)
    damp = w[TABLE + ACROSS, j] * law.damping_s
    stretch = np.sqrt(new_x * new_x + new_y * new_y)
    bent = bend_for(stretch, w[BENT, j], bending, shortening, compliance, pressed, along)
    force, normal, _, _ = column(bent, bending, shortening, pressed, along)
    secant = force / stretch if stretch > 0.0 else 0.0
    trial_x = secant * new_x + branch_x + soft * (new_x - old_x)
    trial_y = secant * new_y + branch_y + soft * (new_y - old_y) + damp * swerve
    path = w[PATH, j]
    grip, _ = grip_at(field, i, path)
    from_x, from_y = w[FORCE_X, j], w[FORCE_Y, j]
    drive_x, drive_y = trial_x - from_x, trial_y - from_y
    static, before, after = 1.0 + law.static_excess, grip * w[NORMAL, j], grip * normal
    keeps_on = mode == SLIDING and slides_on(
        from_x, from_y, drive_x, drive_y, before, after, law.strengthening
    )
    limit = after * (1.0 if keeps_on else static)
    size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
    if size <= limit * ROUNDING:
        _end(w, j, STUCK, place_x, place_y, trial_x, trial_y, normal, bent, 0.0, -1.0, gain)
        return
    share, left, held, sinks = -1.0, 1.0, 0.0, 0.0
    if not keeps_on:
        share = leaves_at(from_x, from_y, drive_x, drive_y, static * before, limit)
        if mode == STUCK and w[INDENTATION, j] > 0.0 and 0.0 < share < 1.0:
            share = _lets_go_at(share, w, law, j, static * grip, new_x, new_y, h, swerve)
        left = 1.0 - share
        from_x, from_y = from_x + share * drive_x, from_y + share * drive_y
        before += share * (after - before)
        held = share
        sinks = given_way(np.sqrt(from_x * from_x + from_y * from_y), before, damp, law)
        share = touched + (1.0 - touched) * share
    if law.exact_turns:
        start, end = raised(from_x, from_y, before, after) if keeps_on else (before, after)
        ux, uy, top, bottom, way = dragged(
            from_x, from_y, trial_x - from_x, trial_y - from_y, start, end
        )
        ux, uy = turned(ux, uy, top, bottom, way)
        unit_x, unit_y = chord(from_x, from_y, trial_x, trial_y, ux, uy, end)
    else:
        unit_x, unit_y = trial_x / size, trial_y / size
    slid_s = left * (1.0 - touched) * h
    quick, lag, slides = 0.0, 0.0, -1.0
    if slid_s > 0.0:
        earlier_s = w[SLID_S, j] if keeps_on else 0.0
        quick, lag, slides = foreseen(slid_s, 1.0 / slid_s, earlier_s, w[SPEED, j], w[EARLIER, j])
    if not keeps_on:
        # it slips as far as its base moves from then on
        slides = left * ((new_x - old_x) * unit_x + (new_y - old_y) * unit_y)
    ahead, aside, rest_x, rest_y, soft_x, soft_y = along_slip(
        new_x, new_y, old_x, old_y, branch_x, branch_y, w[TABLE + ACROSS, j] * maxwell * gain, damp,
        1.0 / h, swerve, unit_x, unit_y, quick, lag,
    )  # fmt: skip
    slip, bend, far = begun(
        new_x - old_x, new_y - old_y, unit_x, unit_y, slides, w[BENT, j], bending, shortening,
        compliance, pressed, along, field.shape[1] > 1,
    )  # fmt: skip
    unknown = law.strengthening > 0.0 and law.damping_s == 0.0 and before > 0.0 and slid_s > 0.0
    if keeps_on:
        unknown = unknown and slows_down(
            w[SLID_S, j], w[SPEED, j], from_x, from_y, new_x - old_x, new_y - old_y, h, law
        )
    first = np.sqrt(from_x * from_x + from_y * from_y)
    at_slip, at_bend, cone = 0.0, bent, 0.5 * (before + after)
    more = first / before if unknown else 1.0
    found = False
    # a tip that lets go is soon where its slip ends: its speed follows from how it is there
    for _ in range(2 if unknown and not keeps_on else 1):
        if unknown:
            grip, grip_slope = grip_at(field, i, path + at_slip)
            _, _, _, _, steepness = slide_step(
                at_slip, at_bend, ahead, aside, rest_x, rest_y, soft_x, soft_y, pressed, along,
                bending, shortening, compliance, grip * more, grip_slope * more, 0.0, law.weak_mm_s,
            )  # fmt: skip
            speed = relaxed_speed(first, size - first, before, after, cone, steepness, slid_s, law)
            quick, lag = (0.0, speed) if speed >= 0.0 else (quick, lag)
        found, hopeful, tried = False, True, 0
        while not found and hopeful and tried < PASSES:
            grip, grip_slope = grip_at(field, i, path + slip)
            grip, grip_slope = strengthened(grip, grip_slope, slip, quick, lag, law)
            slip, bend, found, hopeful, _ = slide_step(
                slip, bend, ahead, aside, rest_x, rest_y, soft_x, soft_y, pressed, along, bending,
                shortening, compliance, grip, grip_slope, quick, law.weak_mm_s,
            )  # fmt: skip
            found = found and hopeful
            tried += 1
        if not found:
            break
        _, normal, _, _ = column(bend, bending, shortening, pressed, along)
        grip, _ = grip_at(field, i, path + slip)
        more, _ = strengthened(1.0, 0.0, slip, quick, lag, law)
        at_slip, at_bend, cone = slip, bend, grip * normal
    if not found or slip > far:
        slip, bend = slid_surely(
            bent, ahead, aside, rest_x, rest_y, soft_x, soft_y, pressed, along, bending,
            shortening, compliance, field, i, path, quick, lag, law,
        )  # fmt: skip
    force_x, force_y, normal = pulled(
        slip, bend, ahead, aside, rest_x, rest_y, soft_x, soft_y, pressed, along, bending,
        shortening,
    )  # fmt: skip
    # the force lies on the cone of the way that is told, to the last bit
    grip, _ = grip_at(field, i, path + slip)
    grip, _ = strengthened(grip, 0.0, slip, quick, lag, law)
    force_x, force_y = onto_cone(force_x, force_y, unit_x, unit_y, grip * normal)
    _end(
        w, j, SLIDING, place_x + slip * unit_x, place_y + slip * unit_y, force_x, force_y, normal,
        bend, slip, share, gain,
    )  # fmt: skip
    # up to where it lets go the force goes from one end to `from`, then from what is left of that
    sunk_y = from_y * (held + (1.0 - held) * sinks)
    w[KICK, j] = sunk_y - (1.0 - held) * w[FORCE_Y, j] - held * w[END_FORCE_Y, j]


@njit(cache=True, nogil=True, error_model="numpy")
def respond(flat, field, law, first, count, sensor, plate_y, swerve, h, decay, gain):  # type: ignore[no-untyped-def]
    """Find what becomes of a block's tips in a step; the state stays.

    Args:
        flat: a block (`rigs.scene.springs`); END_MODE to GAIN are written.
        first, count: the block's first tip, and how many it has.
        sensor: x, y, depth (mm) at the end of the step, and the two slopes of depth, (5,).
        plate_y: height of the plate at the end of the step, mm.
        swerve, h, decay, gain: as in `rigs.scene.contact.tip_step`.
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


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def slide_on(w, field, law, first, count, h, swerve, decay, gain):  # type: ignore[no-untyped-def]
    """Let the tips slide whose END_MODE says so.

    Args:
        w: a block (`rigs.scene.springs`) in which `rigs.scene.contact` has decided.
        first, count, swerve, h, decay, gain: as in `rigs.scene.contact.respond`.

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


@njit(cache=True, nogil=True, error_model="numpy")
def move_tips(lanes, n, field, law, sensor, plate_y, swerve, start_s, h, decay, gain):  # type: ignore[no-untyped-def]
    """Advance every tip by one step in which sensor and plate move linearly.

    Args:
        lanes: blocks of `n` tips (`rigs.scene.springs`).
        sensor: x, y, depth (mm) at the end of the step, and the two slopes of depth, (5,).
        plate_y: height of the plate at the end of the step, mm.
        start_s: when the step begins, s.
    """
    for k in range(lanes.shape[0]):
        first = k * LANES
        respond(
            lanes[k], field, law, first, min(n - first, LANES), sensor, plate_y, swerve, h, decay,
            gain,
        )  # fmt: skip
        settle(lanes[k], law, start_s, h, decay)


@njit(cache=True, nogil=True, error_model="numpy")
def record(lanes, n, plate_y, track, load):  # type: ignore[no-untyped-def]
    """Write the state into a row of `track` (see `track_width`) and of `load` if that has room."""
    for k in range(lanes.shape[0]):
        w, first = block_of(lanes[k]), k * LANES
        for j in range(min(n - first, LANES)):
            i = first + j
            track[2 * i], track[2 * i + 1] = w[PLACE_X, j], w[PLACE_Y, j]
            track[2 * n + i], track[3 * n + i] = w[PATH, j], w[SLIPPED, j]
        if load.shape[0] == 3 * n:
            for j in range(min(n - first, LANES)):
                i = 3 * (first + j)
                load[i], load[i + 1], load[i + 2] = w[FORCE_X, j], w[FORCE_Y, j], w[NORMAL, j]
    track[4 * n] = plate_y


@njit(cache=True, nogil=True, error_model="numpy")
def advance(table, field, law, state, t_ns, sensor, plate_y, track, load):  # type: ignore[no-untyped-def]
    """Advance `tips` from row to row with the plate where it is told.

    Args:
        t_ns: when the first step begins and when each ends, rising, int64, (m + 1,).
        sensor: x, y, depth (mm) and the two slopes of depth at the end of each step, (m, 5).
        plate_y: height of the plate, mm: before the first step, and after each, (m + 1,).
        track: filled with one row a step, (m, track_width(n)).
        load: tangential force x, y and normal force of each tip, N, (m, 3 n); or (m, 0).
    """
    n, lanes = state.shape[0], spread(table, field, state)
    step_ns, h, decay, gain = np.int64(0), 0.0, 1.0, 1.0
    for k in range(sensor.shape[0]):
        if t_ns[k + 1] - t_ns[k] != step_ns:
            step_ns = t_ns[k + 1] - t_ns[k]
            h = step_ns * 1e-9
            decay, gain = relaxing(h, law.relaxation_s)
        move_tips(
            lanes, n, field, law, sensor[k], plate_y[k + 1], 0.0, t_ns[k] * 1e-9, h, decay, gain
        )
        record(lanes, n, plate_y[k + 1], track[k], load[k])
    gather(lanes, state)
