"""What becomes of one tip in one step, whatever happens to it: touching, sticking, slipping.

A spring in series with a Coulomb slider is the least that shows incipient slip: tips with little
normal force let go first, so slip runs from the outer layer to the centre by itself. The update
is a return mapping (Simo and Hughes, Computational Inelasticity, 1998, ch. 1): assume that the
tip sticks; if its force left the friction cone, find the slip that puts it back onto the cone.
That is stable at any step and stiffness, does not creep, and is exact on straight paths.

Columns are in `rigs.scene.column`, turns in `rigs.scene.turning`, the slip in
`rigs.scene.sliding`. This is the law in full; `rigs.scene.lanes` has its two frequent cases for
many tips at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.column import ITERATIONS, bend_for, column, relaxing
from sliplab.rigs.scene.friction import grip_at
from sliplab.rigs.scene.rows import (
    DEEP,
    END_BENT,
    END_FORCE_X,
    END_FORCE_Y,
    END_MODE,
    END_NORMAL,
    END_X,
    END_Y,
    GAIN,
    KICK,
    SHARE,
    SLIP,
    TABLE,
    TO_X,
    TO_Y,
)
from sliplab.rigs.scene.sliding import (
    PASSES,
    along_slip,
    begun,
    foreseen,
    given_way,
    onto_cone,
    pulled,
    relaxed_speed,
    slid_surely,
    slide_step,
    slows_down,
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
    FREE,
    INDENTATION,
    MODE,
    NORMAL,
    NORMAL_BRANCH,
    PATH,
    PLACE_X,
    PLACE_Y,
    SHORTER,
    SLID_S,
    SLIDING,
    SPEED,
    STUCK,
)
from sliplab.rigs.scene.turning import chord, dragged, leaves_at, raised, slides_on, turned

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
