"""Tips of papillae that stick to the plate and slide on it: one nonlinear Jenkins element each.

A spring in series with a Coulomb slider is the least that shows incipient slip: tips with little
normal force let go first, so slip runs from the outer layer to the centre by itself. The update
is a return mapping (Simo and Hughes, Computational Inelasticity, 1998, ch. 1): assume that the
tip sticks; if its force left the friction cone, find the slip that puts it back onto the cone.
That is stable at any step and stiffness, does not creep, and is exact on straight paths.

Columns are in `rigs.scene.column`, turns in `rigs.scene.turning`.

All places are in the plate's frame: millimetres, newtons, seconds. Forces are those of the skin
on the plate. Rows may be any time apart; the same rows give the same bits in any pieces.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.column import CLOSE, bend_for, column, relaxing
from rigs.scene.friction import grip_at
from rigs.scene.springs import (
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
from rigs.scene.turning import leaves_at, turned, unit

# a force this little over its limit is rounding, not slip: a tip at rest must stay to the bit
_ROUNDING = 1.0 + 1e-13
_ITERATIONS = 60


@njit(cache=True, nogil=True, error_model="numpy")
def _excess(share, table, law, state, i, limit, new_x, new_y, deep, h):  # type: ignore[no-untyped-def]
    """Force less `limit` times normal force of a tip that has stuck up to a share of a step, N."""
    decay, gain = relaxing(max(share * h, 1e-12), law.relaxation_s)
    old_x = state[i, BASE_X] - state[i, PLACE_X]
    old_y = state[i, BASE_Y] - state[i, PLACE_Y]
    move_x, move_y = share * (new_x - old_x), share * (new_y - old_y)
    x, y = old_x + move_x, old_y + move_y
    along, was = table[i, ALONG], state[i, INDENTATION]
    sunk = share * (deep - was)
    pressed = (
        along * (was + sunk) + state[i, NORMAL_BRANCH] * decay + law.maxwell * along * gain * sunk
    )  # fmt: skip
    stretch = np.sqrt(x * x + y * y)
    bent = bend_for(
        stretch, state[i, BENT], table[i, BENDING], table[i, SHORTER], table[i, COMPLIANCE],
        pressed, along,
    )  # fmt: skip
    force, normal, _, _ = column(bent, table[i, BENDING], table[i, SHORTER], pressed, along)
    secant = force / stretch if stretch > 0.0 else 0.0
    # what damps is proportional to the speed, and that is constant
    soft = table[i, ACROSS] * (law.maxwell * gain + law.damping_s / max(share * h, 1e-12))
    fx = secant * x + state[i, BRANCH_X] * decay + soft * move_x
    fy = secant * y + state[i, BRANCH_Y] * decay + soft * move_y
    return np.sqrt(fx * fx + fy * fy) - limit * normal


@njit(cache=True, nogil=True, error_model="numpy")
def _lets_go_at(guess, table, law, state, i, limit, new_x, new_y, deep, h):  # type: ignore[no-untyped-def]
    """Share of a step at which a stuck tip's force meets its cone: a root of the law itself.

    While a tip sticks its force is a known function of time, relaxation included, so that the
    slip is located exactly in steps of any length (regula falsi, Illinois).
    """
    low, high = 0.0, 1.0
    below = _excess(low, table, law, state, i, limit, new_x, new_y, deep, h)
    above = _excess(high, table, law, state, i, limit, new_x, new_y, deep, h)
    if below >= 0.0 or above <= 0.0:
        return guess
    share, side = guess, 0
    for _ in range(_ITERATIONS):
        if not low < share < high:
            share = 0.5 * (low + high)
        miss = _excess(share, table, law, state, i, limit, new_x, new_y, deep, h)
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
def tip_step(table, field, law, state, i, base_x, base_y, deep, h, decay, gain):  # type: ignore[no-untyped-def]
    """Where tip `i` is after its base moved linearly to a place and depth within `h` seconds.

    `decay` and `gain` are the relaxing branch's exact factors for linear motion over `h`.

    Returns:
        mode, place x and y, force x and y, normal force, bend, slip (mm), and the share of the
        step at which the tip went from stick to slip (negative if it did not). Nothing is
        written.
    """
    along, bending = table[i, ALONG], table[i, BENDING]
    shortening, compliance = table[i, SHORTER], table[i, COMPLIANCE]
    maxwell = law.maxwell
    was, touched = state[i, INDENTATION], 0.0
    if state[i, MODE] == FREE and deep > 0.0:
        touched = was / (was - deep) if was < 0.0 else 1.0
        if was < 0.0:
            gain = relaxing((1.0 - touched) * h, law.relaxation_s)[1]
    pressed = (
        along * deep + state[i, NORMAL_BRANCH] * decay
        + maxwell * along * gain * (deep - (was if was > 0.0 else 0.0))
    )  # fmt: skip
    if deep <= 0.0 or pressed <= 0.0:
        # clear of the plate, or the skin comes back more slowly than the sensor
        return FREE, base_x, base_y, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0
    mode, place_x, place_y = state[i, MODE], state[i, PLACE_X], state[i, PLACE_Y]
    old_x, old_y = state[i, BASE_X] - place_x, state[i, BASE_Y] - place_y
    if mode == FREE:
        # the tip stands under its base when it touches, on the way there in this step
        place_x = state[i, BASE_X] + touched * (base_x - state[i, BASE_X]) if was < 0.0 else base_x
        place_y = state[i, BASE_Y] + touched * (base_y - state[i, BASE_Y]) if was < 0.0 else base_y
        old_x, old_y = 0.0, 0.0
    new_x, new_y = base_x - place_x, base_y - place_y
    branch_x, branch_y = state[i, BRANCH_X] * decay, state[i, BRANCH_Y] * decay
    soft = table[i, ACROSS] * (maxwell * gain + law.damping_s / h)
    stretch = np.sqrt(new_x * new_x + new_y * new_y)
    bent = bend_for(stretch, state[i, BENT], bending, shortening, compliance, pressed, along)
    force, normal, _, _ = column(bent, bending, shortening, pressed, along)
    secant = force / stretch if stretch > 0.0 else 0.0
    trial_x = secant * new_x + branch_x + soft * (new_x - old_x)
    trial_y = secant * new_y + branch_y + soft * (new_y - old_y)
    grip, _ = grip_at(field, i, state[i, PATH])
    from_x, from_y = state[i, FORCE_X], state[i, FORCE_Y]
    drive_x, drive_y = trial_x - from_x, trial_y - from_y
    static, before = 1.0 + law.static_excess, grip * state[i, NORMAL]
    # a sliding tip slides on if the drive takes its force outwards faster than the cone grows
    outwards = from_x * drive_x + from_y * drive_y
    keeps_on = mode == SLIDING and outwards >= before * (grip * normal - before)
    limit = grip * normal * (1.0 if keeps_on else static)
    size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
    if size <= limit * _ROUNDING:
        return STUCK, place_x, place_y, trial_x, trial_y, normal, bent, 0.0, -1.0
    share, left = -1.0, 1.0
    if not keeps_on:
        share = leaves_at(from_x, from_y, drive_x, drive_y, static * before, limit)
        if mode == STUCK and state[i, INDENTATION] > 0.0 and 0.0 < share < 1.0:
            share = _lets_go_at(
                share, table, law, state, i, static * grip, new_x, new_y, deep, h
            )  # fmt: skip
        left = 1.0 - share
        from_x, from_y = from_x + share * drive_x, from_y + share * drive_y
        before += share * (grip * normal - before)
        share = touched + (1.0 - touched) * share
    if law.exact_turns:
        unit_x, unit_y = turned(
            from_x, from_y, left * drive_x, left * drive_y, before, grip * normal
        )
    else:
        unit_x, unit_y = trial_x / size, trial_y / size
    # with the force F n on the cone, the spring's share of it points along F n + rest; the slip
    # left by a bend decides on the coefficient of friction, and so on F
    rest_x, rest_y = soft * old_x - branch_x, soft * old_y - branch_y
    towards_x, towards_y = unit(before * unit_x + rest_x, before * unit_y + rest_y)
    # speed at the end of the step: a line, or a parabola, through the mean speeds of the last steps
    slid_s = left * (1.0 - touched) * h
    weight, rest = 1.0, 0.0
    low, high, guess = 0.0, bent, state[i, BENT]
    if keeps_on and state[i, SLID_S] > 0.0:
        ahead = slid_s / (slid_s + state[i, SLID_S])
        weight, rest = 1.0 + ahead, -ahead * state[i, SPEED]
        if state[i, SLID_S] == slid_s and state[i, EARLIER] >= 0.0:
            weight = 11.0 / 6.0
            rest = state[i, EARLIER] / 3.0 - 7.0 / 6.0 * state[i, SPEED]
            # the bend if the tip slid on as it did
            slides = (2.0 * state[i, SPEED] - state[i, EARLIER]) * slid_s
            moved = (new_x - old_x) * towards_x + (new_y - old_y) * towards_y
            guess += (moved - slides) / (1.0 + compliance * bending)
    bent = min(max(guess, 0.0), high)
    slip, limit, stretch = 0.0, 0.0, 0.0
    faster, rate, known = 1.0, 0.0, -1.0
    for _ in range(_ITERATIONS):
        spring, normal, slope, normal_slope = column(bent, bending, shortening, pressed, along)
        stretch, stretch_slope = bent + compliance * spring, 1.0 + compliance * slope
        slip_x, slip_y = new_x - stretch * towards_x, new_y - stretch * towards_y
        slip = np.sqrt(slip_x * slip_x + slip_y * slip_y)
        straight = slip_x * towards_x + slip_y * towards_y
        straight = 1.0 if straight >= slip * (1.0 - 1e-9) else straight / slip
        grip, grip_slope = grip_at(field, i, state[i, PATH] + slip)
        if law.strengthening != 0.0 and slid_s > 0.0:
            speed = max(weight * slip / slid_s + rest, 0.0)
            if known < 0.0 or abs(speed - known) > 1e-4 * (known + law.weak_mm_s):
                faster = 1.0 + law.strengthening * np.log1p(speed / law.weak_mm_s)
                rate = law.strengthening / (law.weak_mm_s + speed)
                known = speed
            more = faster + rate * (speed - known)
            grip_slope *= more
            if speed > 0.0:
                grip_slope += grip * rate * weight / slid_s
            grip *= more
        limit = grip * normal
        limit_slope = grip * normal_slope - normal * grip_slope * stretch_slope * straight
        pull, pull_slope = limit, limit_slope
        if soft != 0.0:
            pull_x, pull_y = limit * unit_x + rest_x, limit * unit_y + rest_y
            pull = np.sqrt(pull_x * pull_x + pull_y * pull_y)
            if pull > 0.0:
                towards_x, towards_y = pull_x / pull, pull_y / pull
        miss, steepness = spring + soft * stretch - pull, slope + soft * stretch_slope - pull_slope
        if miss > 0.0:
            high = bent
        else:
            low = bent
        change = -miss / steepness if steepness > 0.0 else 0.5 * (low + high) - bent
        if not low <= bent + change <= high:
            change = 0.5 * (low + high) - bent
        bent += change
        if abs(change) <= CLOSE * bent:
            # the next change would be of the order of its square: rounding
            stretch += stretch_slope * change
            limit += limit_slope * change
            normal += normal_slope * change
            break
    if soft != 0.0:
        # a direction that lags behind by a hair would make the way longer, step by step
        towards_x, towards_y = unit(limit * unit_x + rest_x, limit * unit_y + rest_y)
    slip_x, slip_y = new_x - stretch * towards_x, new_y - stretch * towards_y
    slip = np.sqrt(slip_x * slip_x + slip_y * slip_y)
    # the force lies on the cone of the way that is told, to the last bit
    grip, _ = grip_at(field, i, state[i, PATH] + slip)
    if known >= 0.0:
        grip *= faster + rate * (max(weight * slip / slid_s + rest, 0.0) - known)
    limit = grip * normal
    return (
        SLIDING, base_x - stretch * towards_x, base_y - stretch * towards_y,
        limit * unit_x, limit * unit_y, normal, bent, slip, share,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def move_tips(table, field, law, state, sensor, plate_y, start_s, h, decay, gain):  # type: ignore[no-untyped-def]
    """Advance every tip by one step in which sensor and plate move linearly.

    Args:
        sensor: x, y, depth (mm) at the end of the step, and the two slopes of depth, (5,).
        plate_y: height of the plate at the end of the step, mm.
        start_s: when the step begins, s.
    """
    for i in range(state.shape[0]):
        lx, ly = table[i, LAYOUT_X], table[i, LAYOUT_Y]
        base_x, base_y = sensor[0] + lx, sensor[1] + ly - plate_y
        deep = sensor[2] + sensor[3] * lx + sensor[4] * ly - table[i, GAP]
        mode, x, y, force_x, force_y, normal, bent, slip, share = tip_step(
            table, field, law, state, i, base_x, base_y, deep, h, decay, gain
        )
        if mode == FREE:
            state[i, BRANCH_X] = state[i, BRANCH_Y] = 0.0
            state[i, NORMAL_BRANCH] = -table[i, ALONG] * max(deep, 0.0)
        else:
            soft = law.maxwell * gain
            if state[i, MODE] == FREE and state[i, INDENTATION] < 0.0:
                # as in `tip_step`: it touched on the way
                since = deep / (deep - state[i, INDENTATION])
                soft = law.maxwell * relaxing(since * h, law.relaxation_s)[1]
            was = state[i, INDENTATION] if state[i, INDENTATION] > 0.0 else 0.0
            state[i, NORMAL_BRANCH] = state[i, NORMAL_BRANCH] * decay + soft * table[i, ALONG] * (
                deep - was
            )
            if state[i, MODE] == FREE:
                state[i, BASE_X] = state[i, PLACE_X] = x
                state[i, BASE_Y] = state[i, PLACE_Y] = y
            soft *= table[i, ACROSS]
            stretch_x = base_x - x - state[i, BASE_X] + state[i, PLACE_X]
            stretch_y = base_y - y - state[i, BASE_Y] + state[i, PLACE_Y]
            state[i, BRANCH_X] = state[i, BRANCH_X] * decay + soft * stretch_x
            state[i, BRANCH_Y] = state[i, BRANCH_Y] * decay + soft * stretch_y
        state[i, INDENTATION] = deep
        state[i, MODE] = mode
        state[i, BASE_X], state[i, BASE_Y] = base_x, base_y
        state[i, PLACE_X], state[i, PLACE_Y] = x, y
        state[i, FORCE_X], state[i, FORCE_Y] = force_x, force_y
        state[i, NORMAL], state[i, BENT] = normal, bent
        if share >= 0.0:
            state[i, SLIPPED] = start_s + share * h
        slid_s = h * (1.0 - max(share, 0.0)) if slip > 0.0 else 0.0
        earlier = state[i, SPEED] if slid_s > 0.0 and state[i, SLID_S] == slid_s else -1.0
        state[i, EARLIER] = earlier
        state[i, SLID_S] = slid_s
        state[i, SPEED] = slip / slid_s if slid_s > 0.0 else 0.0
        state[i, PATH] += slip


@njit(cache=True, nogil=True, error_model="numpy")
def record(state, plate_y, track, load):  # type: ignore[no-untyped-def]
    """Write the state into a row of `track` (see `track_width`) and of `load` if that has room."""
    n = state.shape[0]
    for i in range(n):
        track[2 * i], track[2 * i + 1] = state[i, PLACE_X], state[i, PLACE_Y]
        track[2 * n + i], track[3 * n + i] = state[i, PATH], state[i, SLIPPED]
    track[4 * n] = plate_y
    if load.shape[0] == 3 * n:
        for i in range(n):
            load[3 * i], load[3 * i + 1] = state[i, FORCE_X], state[i, FORCE_Y]
            load[3 * i + 2] = state[i, NORMAL]


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
    step_ns, h, decay, gain = np.int64(0), 0.0, 1.0, 1.0
    for k in range(sensor.shape[0]):
        if t_ns[k + 1] - t_ns[k] != step_ns:
            step_ns = t_ns[k + 1] - t_ns[k]
            h = step_ns * 1e-9
            decay, gain = relaxing(h, law.relaxation_s)
        move_tips(
            table, field, law, state, sensor[k], plate_y[k + 1], t_ns[k] * 1e-9, h, decay, gain
        )
        record(state, plate_y[k + 1], track[k], load[k])
