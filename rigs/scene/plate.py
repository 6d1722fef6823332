"""A plate that falls on its slider while tips stick to it and let go.

The plate's speed is the one unknown of an implicit time step (Moreau 1988; Jean 1999: velocities
at the end of the step, forces by projection onto friction cones). Forces fall monotonically with
the plate's speed, so one scalar equation with a bracket round its root decides the step, however
many tips change between stick and slip in it. Regularised friction would let a held plate creep.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from rigs.scene.contact import FREE, begin_step, end_step, record

_ITERATIONS = 200


@njit(cache=True, nogil=True)
def _pull(tips, scratch, move):  # type: ignore[no-untyped-def]
    """Upward force of all tips on the plate after it moved up by `move` mm, N, and its slope."""
    total, slope = 0.0, 0.0
    for i in range(tips.mode.shape[0]):
        if tips.mode[i] == FREE:
            continue
        own = scratch.stiffness[i]
        force_x, force_y = scratch.trial[i, 0], scratch.trial[i, 1] - own * move
        size, limit = np.hypot(force_x, force_y), scratch.limit[i]
        if size > limit:
            total += force_y * (limit / size)
            slope -= own * (limit / size) * (force_x / size) ** 2
        else:
            total += force_y
            slope -= own
    return total, slope


@njit(cache=True, nogil=True)
def _solve(tips, scratch, h, mass, speed, weight, stiction):  # type: ignore[no-untyped-def]
    """The plate's speed at the end of the step, mm/s upwards; mass in kg, forces in N."""
    inertia = mass * 1e-3 / h  # N per mm/s
    rest, _ = _pull(tips, scratch, 0.0)
    push = rest - weight + inertia * speed
    if abs(push) <= stiction:
        return 0.0
    push_sign = 1.0 if push > 0.0 else -1.0
    drag = stiction * push_sign
    # f(v) = inertia (v - speed) + weight + drag - pull(v h) grows with v; its root lies between 0
    # and the speed that the plate would have if the tips' force stayed as it is at rest
    low, high = (0.0, (push - drag) / inertia) if push > 0 else ((push - drag) / inertia, 0.0)
    v = min(max(speed, low), high)
    for _ in range(_ITERATIONS):
        pull, slope = _pull(tips, scratch, v * h)
        f = inertia * (v - speed) + weight + drag - pull
        if f > 0.0:
            high = v
        elif f < 0.0:
            low = v
        else:
            return v
        following = v - f / (inertia - slope * h)
        if not low < following < high:
            following = 0.5 * (low + high)
        if following in (v, low, high):
            return following
        if abs(following - v) <= 1e-15 * abs(v):
            return following
        v = following
    return v


@njit(cache=True, nogil=True)
def advance_free(  # type: ignore[no-untyped-def]
    springs, tips, scratch, h, sensor, motion, mass, weight, stiction, stop, track, load
):
    """Advance tips and plate together until the steps end or the plate meets its stop.

    Args:
        sensor: as in `rigs.scene.contact.advance`, (m, 5).
        motion: height (mm) and upward speed (mm/s) of the plate, (2,); written in place.
        mass: kg.
        weight: what the catch leaves of the plate's weight at the end of each step, N, (m,).
        stiction: dry friction of the slider, N.
        stop: height of the stop, mm.
        track, load: as in `rigs.scene.contact.advance`.

    Returns:
        steps taken; less than m when the plate came to rest on its stop in the last of them.
    """
    decay = np.exp(-h / springs.relaxation_s)
    gain = springs.relaxation_s * -np.expm1(-h / springs.relaxation_s) / h
    for k in range(sensor.shape[0]):
        begin_step(springs, tips, scratch, h, decay, gain, sensor[k], motion[0])
        speed = _solve(tips, scratch, h, mass, motion[1], weight[k], stiction)
        move = speed * h
        landed = motion[0] + move <= stop
        if landed:
            move, speed = stop - motion[0], 0.0
        end_step(springs, tips, scratch, decay, gain, move)
        motion[0] = stop if landed else motion[0] + move
        motion[1] = speed
        record(tips, motion[0], track[k], load[k])
        if landed:
            return k + 1
    return sensor.shape[0]
