"""A plate that falls on its slider while tips stick to it and let go.

The plate's speed at the end of a step is the one unknown (Moreau 1988; Jean 1999: velocities at
the end, forces by projection onto friction cones). Height and momentum are those of the mean speed
and the mean force of both ends, so that onsets are of second order in the step. A plate so light
that its own swing is faster than the steps takes speed and force of the end alone: of first order,
but without ringing. Forces fall monotonically with the plate's speed, so one scalar equation with a
bracket round its root decides the step, however many tips change between stick and slip in it.
Where static friction exceeds kinetic, a tip that lets go makes the plate faster at once, so a step
ends where the first one does, were all held, and the rest of it is a separate step.
Regularised friction would let a held plate creep.
"""

from __future__ import annotations

import numpy as np

from sliplab.plugins.simulation.scene.contact import (
    LANES,
    Block,
    Blocks,
    ContactStep,
    feel_spots,
    make_blocks,
    move_tips,
    record,
    respond,
    store_state,
)
from sliplab.plugins.simulation.scene.slip import relaxing
from sliplab.plugins.simulation.scene.springs import ACROSS, STUCK, Law
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64

_ITERATIONS = 200
_NEVER = 1e9
"""An excess of static friction that holds every tip."""


@njit(cache=True, nogil=True, error_model="numpy")
def _pull(
    blocks: Blocks,
    n: int,
    field: F64,
    law: Law,
    sensor: F64,
    plate_y: float,
    step: ContactStep,
    new: float,
) -> float:
    """Upward force of all tips on the plate if it came to `plate_y` mm in this step, N.

    It is the effective force at the end of the step, so that its mean with the beginning (`new`) is
    that over the step: the force of a tip that lets go falls in no time.
    """
    total = 0.0
    for k in range(blocks.shape[0]):
        first = k * LANES
        count = min(n - first, LANES)
        respond(blocks[k], field, law, first, count, sensor, plate_y, step)
        w = blocks[k]
        for j in range(count):
            total += w.end_force_y[j]
            if new < 1.0 and w.share[j] >= 0.0:
                total += w.kick[j]
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def _solve(
    blocks: Blocks,
    n: int,
    field: F64,
    law: Law,
    sensor: F64,
    motion: F64,
    step: ContactStep,
    mass: float,
    weight: float,
    stiction: float,
    new: float,
    pulls: float,
) -> float:
    """The plate's speed at the end of the step, mm/s upwards; mass in kg, forces in N.

    Args:
        weight: mean over the step.
        new: share of the end's speed and force in their means.
        pulls: upward force of the tips when the step begins.
    """
    h, decay, gain, _ = step
    inertia = mass * 1e-3 / h  # N per mm/s
    plate_y, speed = motion[0] + (1.0 - new) * motion[1] * h, motion[1]
    weight -= (1.0 - new) * pulls
    at_rest = ContactStep(h, decay, gain, (1.0 - new) * speed)
    rest = _pull(blocks, n, field, law, sensor, plate_y, at_rest, new)
    push = new * rest - weight + inertia * speed
    if abs(push) <= stiction:
        return 0.0
    drag = stiction if push > 0.0 else -stiction
    # f(v) = inertia (v - speed) + weight + drag - pull(v) grows with v; its root lies between 0
    # and the speed that the plate would have if the tips' force stayed as it is at rest
    zero, far = 0.0, (push - drag) / inertia
    f_zero, f_far = drag - push, np.nan
    v = speed if min(zero, far) < speed < max(zero, far) else far
    for _ in range(_ITERATIONS):
        f = inertia * (v - speed) + weight + drag
        moving = ContactStep(h, decay, gain, (1.0 - new) * (speed - v))
        f -= new * _pull(blocks, n, field, law, sensor, plate_y + new * v * h, moving, new)
        if f == 0.0:
            return v
        if (f > 0.0) == (f_zero > 0.0):
            slope = (f - f_zero) / (v - zero)
            zero, f_zero = v, f
        else:
            slope = (f - f_far) / (v - far) if f_far == f_far and v != far else np.nan
            if not slope > 0.0:
                slope = (f - f_zero) / (v - zero)
            far, f_far = v, f
        following = v - f / slope if slope > 0.0 else 0.5 * (zero + far)
        if not min(zero, far) < following < max(zero, far):
            following = 0.5 * (zero + far)
        if following in (v, zero, far) or abs(following - v) <= 1e-15 * abs(v):
            return following
        v = following
    return v


@njit(cache=True, nogil=True, error_model="numpy")
def advance_free(
    table: F64,
    friction: F64,
    law: Law,
    state: F64,
    t_ns: I64,
    sensor: F64,
    motion: F64,
    mass: float,
    weight: F64,
    stiction: float,
    stop: float,
    track: F64,
    load: F64,
    spots: F64,
) -> tuple[int, bool]:
    """Advance tips and plate together until the steps end or the plate meets its stop.

    Args:
        t_ns: when the first step begins and when each ends, rising, int64, (m + 1,); the time at
            which the plate meets its stop is written in place of the end of that step.
        sensor: as in `scene.contact.advance`, (m, 5).
        motion: height (mm) and upward speed (mm/s) of the plate, (2,); written in place.
        mass: kg.
        weight: what the catch leaves of the plate's weight at those times, N, (m + 1,).
        stiction: dry friction of the slider, N.
        stop: height of the stop, mm.
        table, friction, law, state, track, load, spots: as in `scene.contact.advance`.

    Returns:
        steps taken, and whether the plate came to rest on its stop in the last of them.
    """
    n, blocks = state.shape[0], make_blocks(table, friction, state)
    field, factors = friction, np.ones(n)
    if spots.shape[0] > 0:
        field = friction.copy()
    holding = Law(
        _NEVER,
        law.strengthening,
        law.weak_mm_s,
        law.maxwell,
        law.relaxation_s,
        law.damping_s,
        law.exact_turns,
        law.creep_mm_s,
        law.creep_share,
        law.least_mm_s,
        law.curvature,
    )
    step_ns, h, decay, gain, new, stiffness = np.int64(0), 0.0, 1.0, 1.0, 0.5, 0.0
    for i in range(n):
        stiffness += table[i, ACROSS]
    for k in range(sensor.shape[0]):
        begin_ns, begin_weight = t_ns[k], weight[k]
        while True:
            if spots.shape[0] > 0:
                feel_spots(blocks, n, friction, field, spots, factors)
            if t_ns[k + 1] - begin_ns != step_ns:
                step_ns = t_ns[k + 1] - begin_ns
                h = step_ns * 1e-9
                decay, gain = relaxing(h, law.relaxation_s)
                new = 0.5 if 1e3 * stiffness * h * h <= mass else 1.0
            mean_weight = new * weight[k + 1] + (1.0 - new) * begin_weight
            pulls = 0.0
            for i in range(n):
                pulls += blocks[i // LANES].force_y[i % LANES]
            before, step = motion[1], ContactStep(h, decay, gain, 0.0)
            speed = _solve(
                blocks,
                n,
                field,
                law,
                sensor[k],
                motion,
                step,
                mass,
                mean_weight,
                stiction,
                new,
                pulls,
            )
            if new == 1.0 or law.static_excess == 0.0 or _lets_go_first(blocks, n) > 1.0:
                break
            # a tip that lets go makes the plate faster, which may not have made it let go
            held = _solve(
                blocks,
                n,
                field,
                holding,
                sensor[k],
                motion,
                step,
                mass,
                mean_weight,
                stiction,
                new,
                pulls,
            )
            _pull(
                blocks,
                n,
                field,
                law,
                sensor[k],
                motion[0] + 0.5 * (before + held) * h,
                ContactStep(h, decay, gain, 0.5 * (before - held)),
                new,
            )
            share = _lets_go_first(blocks, n)
            if share > 1.0:
                speed = held
                break
            ns = np.int64(share * step_ns)
            share = ns / step_ns
            height = motion[0] + h * share * (before + 0.5 * share * (held - before))
            if ns < 1 or ns == step_ns or height <= stop:
                break
            # the step ends where the first tip lets go, and its rest is another
            at = _between(blocks[0], law, motion[0], sensor[k], share)
            part = ns * 1e-9
            decay, gain = relaxing(part, law.relaxation_s)
            move_tips(
                blocks,
                n,
                field,
                holding,
                at,
                height,
                begin_ns * 1e-9,
                ContactStep(part, decay, gain, 0.5 * share * (before - held)),
            )
            motion[0], motion[1] = height, before + share * (held - before)
            begin_weight += share * (weight[k + 1] - begin_weight)
            begin_ns += ns
        mean = new * speed + (1.0 - new) * before
        height = motion[0] + mean * h
        landed = height <= stop
        if landed:
            share = _lands_at(motion[0] - stop, mean * h, (mean - speed) * h)
            ns = min(max(np.int64(np.ceil(share * step_ns)), np.int64(1)), step_ns)
            share = ns / step_ns
            at = _between(blocks[0], law, motion[0], sensor[k], share)
            t_ns[k + 1] = begin_ns + ns
            h = ns * 1e-9
            decay, gain = relaxing(h, law.relaxation_s)
            height, swerve, motion[1] = stop, (mean - speed) * share, 0.0
        else:
            at, swerve, motion[1] = sensor[k], mean - speed, speed
        step = ContactStep(h, decay, gain, swerve)
        move_tips(blocks, n, field, law, at, height, begin_ns * 1e-9, step)
        motion[0] = height
        record(blocks, n, height, track[k], load[k])
        if landed:
            store_state(blocks, state)
            return k + 1, True
    store_state(blocks, state)
    return sensor.shape[0], False


@njit(cache=True, nogil=True, error_model="numpy")
def _lets_go_first(blocks: Blocks, n: int) -> float:
    """Share of a step at which the first of the tips that stuck lets go; above 1: none does."""
    first = 2.0
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        if w.mode[j] == STUCK and w.share[j] >= 0.0:
            first = min(first, w.share[j])
    return first


@njit(cache=True, nogil=True, error_model="numpy")
def _between(w: Block, law: Law, plate_y: float, sensor: F64, share: float) -> F64:
    """The sensor's pose at a share of a step, from where the first tip's base was; (5,)."""
    at = sensor.copy()
    x, y = w.layout_x[0], w.layout_y[0]
    left = 1.0 - share
    at[0] -= left * (sensor[0] - (w.base_x[0] - x))
    at[1] -= left * (sensor[1] - (w.base_y[0] - y + plate_y))
    away_x, away_y = w.base_x[0], w.base_y[0]
    bulge = 0.5 * law.curvature * (away_x * away_x + away_y * away_y)
    deep = sensor[2] + sensor[3] * x + sensor[4] * y - w.gap[0] - bulge
    # a tip that was never moved does not know how deep it was
    at[2] -= left * (deep - w.indentation[0]) if w.indentation[0] == w.indentation[0] else 0.0
    return at


@njit(cache=True, nogil=True, error_model="numpy")
def _lands_at(above: float, rise: float, bow: float) -> float:
    """Share of a step at which a plate that was `above` its stop meets it.

    Its height changes by s `rise` + s (1 - s) `bow` in a share s of the step, all in mm.
    """
    # -bow s^2 + (rise + bow) s + above = 0, the first root
    half = 0.5 * (rise + bow)
    root = np.sqrt(max(half * half + bow * above, 0.0))
    return above / (root - half) if root > half else 1.0
