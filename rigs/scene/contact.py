"""Tips of papillae that stick to the plate and slide on it: one Jenkins element each.

A spring in series with a Coulomb slider is the least that shows incipient slip: tips with little
normal force let go first, so slip runs from the outer layer to the centre by itself. The update
is a return mapping (Simo and Hughes, Computational Inelasticity, 1998, ch. 1): assume that the
tip sticks, and project the force back onto the friction cone if it left it. That is stable at any
step and stiffness, exact on straight paths, of first order on curved ones, and does not creep.

All places are in the plate's frame: millimetres, newtons, seconds. Forces are those of the skin
on the plate. The state advances on a fixed grid of steps, so chunks cannot matter.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from rigs.scene.randomness import generator
from rigs.scene.skin import Skin

F64 = npt.NDArray[np.float64]
I8 = npt.NDArray[np.int8]

FREE, STUCK, SLIDING = 0, 1, 2
# a force this little over its limit is rounding, not slip: a tip at rest must stay to the bit
_ROUNDING = 1.0 + 1e-13


class Springs(NamedTuple):
    """What does not change during a trial; n papillae."""

    layout: F64
    """Places in the sensor's plane, mm, shape (n, 2)."""
    gap: F64
    """Indentation at which each tip touches, mm, shape (n,)."""
    normal: F64
    """Relaxed normal stiffness, N/mm, shape (n,)."""
    tangential: F64
    """Relaxed tangential stiffness, N/mm, shape (n,)."""
    friction: F64
    """Kinetic coefficient, knots along each tip's path (periodic), shape (n, knots)."""
    knot_mm: float
    """Distance of the knots."""
    static_excess: float
    """Static over kinetic friction, less one."""
    maxwell: float
    """Stiffness of the relaxing branch over the relaxed stiffness."""
    relaxation_s: float
    damping_s: float
    """Viscous part of the tangential spring over its stiffness."""


class Tips(NamedTuple):
    """The state of n tips; arrays that the kernels write in place."""

    place: F64
    """Tip in the plate's frame, mm, shape (n, 2)."""
    base: F64
    """Unloaded tip (sensor plus layout) in the plate's frame, mm, shape (n, 2)."""
    branch: F64
    """Tangential force in the relaxing branch, N, shape (n, 2)."""
    force: F64
    """Tangential force on the plate, N, shape (n, 2)."""
    normal: F64
    """Normal force, N, shape (n,)."""
    normal_branch: F64
    indentation: F64
    path: F64
    """Length of the way slid since the trial began, mm, shape (n,)."""
    mode: I8
    """FREE, STUCK or SLIDING, shape (n,)."""


def new_tips(n: int) -> Tips:
    """`n` tips clear of the plate."""
    return Tips(
        np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros((n, 2)), np.zeros(n),
        np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n, np.int8),
    )  # fmt: skip


def make_springs(
    skin: Skin,
    *,
    friction: F64,
    knot_mm: float = 0.1,
    static_excess: float = 0.0,
    relaxation_share: float = 0.0,
    relaxation_s: float = 1.0,
    damping_s: float = 0.0,
) -> Springs:
    """Springs of a skin.

    Args:
        friction: coefficient of each papilla at knots along its path, shape (n, knots).
        relaxation_share: share of a suddenly applied force that relaxes away, below 1; the
            skin's own stiffnesses are those that remain.
    """
    return Springs(
        skin.layout_mm, skin.gap_mm, skin.normal_n_per_mm, skin.tangential_n_per_mm,
        np.ascontiguousarray(friction), knot_mm, static_excess,
        relaxation_share / (1.0 - relaxation_share), relaxation_s, damping_s,
    )  # fmt: skip


def friction_field(
    skin: Skin,
    kinetic: float,
    variation: float,
    correlation_mm: float,
    seed: int,
    knot_mm: float = 0.1,
    knots: int = 1024,
) -> F64:
    """Kinetic friction along each tip's path: Gaussian, periodic, shape (n, knots).

    Its autocorrelation over a distance d is exp(-(d / correlation_mm)^2); it is kept at or above
    a fifth of the mean.
    """
    mean = (kinetic * skin.friction_factor)[:, None]
    if variation == 0.0:
        return np.ascontiguousarray(np.broadcast_to(mean, (len(skin), 1)).astype(np.float64))
    white = generator(seed, "friction").standard_normal((len(skin), knots))
    away = np.minimum(np.arange(knots), knots - np.arange(knots)) * knot_mm
    kernel = np.exp(-2.0 * (away / correlation_mm) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))
    smooth = np.zeros_like(white)
    # summed term by term in a fixed order: an FFT's rounding would depend on its build
    for shift in np.flatnonzero(kernel > 1e-7):
        smooth += kernel[shift] * np.roll(white, shift, axis=1)
    return np.maximum(mean * (1.0 + variation * smooth), 0.2 * mean)


class Scratch(NamedTuple):
    """What one step works with before the plate's motion is known; n papillae."""

    trial: F64
    """Force if every tip stuck and the plate stood, shape (n, 2)."""
    stiffness: F64
    """Force per base motion within this step, N/mm, shape (n,)."""
    limit: F64
    """Radius of the friction cone, N, shape (n,)."""
    move: F64
    """Base motion of this step in the plate's frame, the plate standing, shape (n, 2)."""
    base: F64
    """Where the base comes to in the plate's frame, the plate standing, mm, shape (n, 2)."""


def new_scratch(n: int) -> Scratch:
    """Room for one step."""
    return Scratch(np.zeros((n, 2)), np.zeros(n), np.zeros(n), np.zeros((n, 2)), np.zeros((n, 2)))


@njit(cache=True, nogil=True)
def begin_step(springs, tips, scratch, h, decay, gain, sensor, plate_y):  # type: ignore[no-untyped-def]
    """Normal forces, cones and trial forces of one step with the plate standing at `plate_y`.

    `sensor`: x, y, depth, and the slopes of depth over x and y of the layout. `decay` and `gain`
    are the relaxing branch's exact factors for linear motion over `h`.
    """
    maxwell = springs.maxwell
    for i in range(springs.gap.shape[0]):
        lx, ly = springs.layout[i, 0], springs.layout[i, 1]
        base_x, base_y = sensor[0] + lx, sensor[1] + ly - plate_y
        deep = sensor[2] + sensor[3] * lx + sensor[4] * ly - springs.gap[i]
        deep = max(deep, 0.0)
        branch = tips.normal_branch[i] * decay
        branch += maxwell * springs.normal[i] * gain * (deep - tips.indentation[i])
        normal = springs.normal[i] * deep + branch
        if deep <= 0.0:
            normal, branch = 0.0, 0.0
        elif normal <= 0.0:
            # the skin comes back more slowly than the sensor: it hangs clear of the plate
            normal, branch = 0.0, -springs.normal[i] * deep
        tips.indentation[i] = deep
        tips.normal_branch[i] = branch
        tips.normal[i] = normal
        if normal <= 0.0 or tips.mode[i] == FREE:
            # clear of the plate, or touching it first: the tip stands under its base
            tips.mode[i] = STUCK if normal > 0.0 else FREE
            tips.place[i, 0], tips.place[i, 1] = base_x, base_y
            tips.base[i, 0], tips.base[i, 1] = base_x, base_y
            tips.branch[i, 0] = tips.branch[i, 1] = 0.0
        stiffness = springs.tangential[i]
        own = stiffness * (1.0 + springs.damping_s / h) + maxwell * stiffness * gain
        move_x, move_y = base_x - tips.base[i, 0], base_y - tips.base[i, 1]
        scratch.move[i, 0], scratch.move[i, 1] = move_x, move_y
        scratch.base[i, 0], scratch.base[i, 1] = base_x, base_y
        scratch.stiffness[i] = own
        scratch.trial[i, 0] = (
            stiffness * (tips.base[i, 0] - tips.place[i, 0])
            + tips.branch[i, 0] * decay + own * move_x
        )  # fmt: skip
        scratch.trial[i, 1] = (
            stiffness * (tips.base[i, 1] - tips.place[i, 1])
            + tips.branch[i, 1] * decay + own * move_y
        )  # fmt: skip
        along = tips.path[i] / springs.knot_mm
        knot = int(along)
        share = along - knot
        count = springs.friction.shape[1]
        knot %= count
        following = knot + 1 if knot + 1 < count else 0
        grip = (1.0 - share) * springs.friction[i, knot] + share * springs.friction[i, following]
        if tips.mode[i] == STUCK:
            grip *= 1.0 + springs.static_excess
        scratch.limit[i] = grip * normal


@njit(cache=True, nogil=True)
def end_step(springs, tips, scratch, decay, gain, plate_move):  # type: ignore[no-untyped-def]
    """Project the trial forces onto the cones, the plate having moved up by `plate_move` mm."""
    for i in range(springs.gap.shape[0]):
        move_x, move_y = scratch.move[i, 0], scratch.move[i, 1] - plate_move
        tips.base[i, 0] = scratch.base[i, 0]
        tips.base[i, 1] = scratch.base[i, 1] - plate_move
        if tips.mode[i] == FREE:
            tips.place[i, 0], tips.place[i, 1] = tips.base[i, 0], tips.base[i, 1]
            tips.force[i, 0] = tips.force[i, 1] = 0.0
            continue
        own = scratch.stiffness[i]
        force_x, force_y = scratch.trial[i, 0], scratch.trial[i, 1] - own * plate_move
        size = np.hypot(force_x, force_y)
        limit = scratch.limit[i]
        if size > limit * _ROUNDING:
            held = limit / size
            slip_x, slip_y = force_x * (1.0 - held) / own, force_y * (1.0 - held) / own
            force_x, force_y = force_x * held, force_y * held
            tips.place[i, 0] += slip_x
            tips.place[i, 1] += slip_y
            tips.path[i] += np.hypot(slip_x, slip_y)
            move_x, move_y = move_x - slip_x, move_y - slip_y
            tips.mode[i] = SLIDING
        else:
            tips.mode[i] = STUCK
        soft = springs.maxwell * springs.tangential[i] * gain
        tips.branch[i, 0] = tips.branch[i, 0] * decay + soft * move_x
        tips.branch[i, 1] = tips.branch[i, 1] * decay + soft * move_y
        tips.force[i, 0], tips.force[i, 1] = force_x, force_y


@njit(cache=True, nogil=True)
def record(tips, plate_y, track, load):  # type: ignore[no-untyped-def]
    """Write the state into a row of `track` (see `track_width`) and of `load` if that has room."""
    n = tips.path.shape[0]
    for i in range(n):
        track[2 * i], track[2 * i + 1] = tips.place[i, 0], tips.place[i, 1]
        track[2 * n + i] = tips.path[i]
    track[3 * n] = plate_y
    if load.shape[0] == 3 * n:
        for i in range(n):
            load[3 * i], load[3 * i + 1] = tips.force[i, 0], tips.force[i, 1]
            load[3 * i + 2] = tips.normal[i]


def track_width(n: int) -> int:
    """Columns of a track of `n` tips: x and y of each tip, its path, then the plate's height."""
    return 3 * n + 1


@njit(cache=True, nogil=True)
def advance(springs, tips, scratch, h, sensor, plate_y, track, load):  # type: ignore[no-untyped-def]
    """Advance `tips` through len(sensor) steps of `h` seconds with the plate where it is told.

    Args:
        sensor: x, y, depth (mm) and the two slopes of depth at the end of each step, (m, 5).
        plate_y: height of the plate, mm: before the first step, and after each, (m + 1,).
        track: filled with one row a step, (m, track_width(n)).
        load: tangential force x, y and normal force of each tip, N, (m, 3 n); or (m, 0).
    """
    decay = np.exp(-h / springs.relaxation_s)
    gain = springs.relaxation_s * -np.expm1(-h / springs.relaxation_s) / h
    for k in range(sensor.shape[0]):
        begin_step(springs, tips, scratch, h, decay, gain, sensor[k], plate_y[k])
        end_step(springs, tips, scratch, decay, gain, plate_y[k + 1] - plate_y[k])
        record(tips, plate_y[k + 1], track[k], load[k])
