"""Tips of papillae that stick to the plate and slide on it: one nonlinear Jenkins element each.

Steps from row to row while the plate moves as it is told; `rigs.scene.plate` does so while it
falls. The law is in `rigs.scene.tip`, and in `rigs.scene.lanes` for many tips at once.

All places are in the plate's frame: millimetres, newtons, seconds. Forces are those of the skin
on the plate. Rows may be any time apart; the same rows give the same bits in any pieces.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from sliplab.rigs.scene.column import relaxing
from sliplab.rigs.scene.lanes import respond, settle
from sliplab.rigs.scene.rows import LANES, block_of, gather, spread
from sliplab.rigs.scene.springs import (
    FORCE_X,
    FORCE_Y,
    NORMAL,
    PATH,
    PLACE_X,
    PLACE_Y,
    SLIPPED,
)


@njit(cache=True, nogil=True, error_model="numpy")
def move_tips(lanes, n, field, law, sensor, plate_y, swerve, start_s, h, decay, gain):  # type: ignore[no-untyped-def]
    """Advance every tip by one step in which sensor and plate move linearly.

    Args:
        lanes: blocks of `n` tips (`rigs.scene.rows`).
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
