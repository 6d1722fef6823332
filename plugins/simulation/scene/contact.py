"""The contact law: tips that touch the plate, stick to it and slide on it, many at once.

A spring in series with a Coulomb slider is the least that shows incipient slip: tips with little
normal force let go first, so slip runs from the outer layer to the centre by itself. The update
is a return mapping (Simo and Hughes, Computational Inelasticity, 1998, ch. 1): assume that the
tip sticks; if its force left the friction cone, find the slip that puts it back onto the cone.
That is stable at any step and stiffness, does not creep, and is exact on straight paths.

A tip's step is a chain of square roots and quotients that each wait for the one before, but tips
do not wait for each other. So up to `LANES` tips share a block, and every stage is a short loop
over its lanes without a branch, of which a processor computes several at once; a lane whose search
has ended keeps its values. What is rare (touching, letting go, being caught by rough friction) is
prepared lane by lane, and goes through the same stages. The equations of one lane are in
`scene.slip` and `scene.friction`.

`advance` steps from row to row while the plate moves as prescribed; `scene.plate` does so
while it falls. All places are in the plate's frame: millimetres, newtons, seconds. Forces are those
of the skin on the plate. Rows may be any time apart; the same rows give the same bits however they
are cut into calls.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sliplab.plugins.simulation.scene import springs as of
from sliplab.plugins.simulation.scene.friction import (
    cubic_at,
    grip_at,
    grip_between,
    keeps_sliding,
    knot_at,
    leaves_cone_at,
    raised_cone,
    slip_direction,
    spot_factor,
    tractrix,
    tractrix_end,
)
from sliplab.plugins.simulation.scene.slip import (
    ITERATIONS,
    PASSES,
    along_slip,
    bend_for,
    bend_step,
    column,
    creep_slip,
    first_bend,
    first_slip,
    force_after,
    force_kept,
    is_steady,
    march_to_slip,
    onto_cone,
    predicted_speed,
    relaxed_speed,
    relaxing,
    slip_step,
    slows_down,
    strengthened,
)
from sliplab.plugins.simulation.scene.springs import FREE, SLIDING, STUCK, Law
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F64, I64

LANES = 20
"""Nineteen papillae, and one more for whole registers of four."""
BLOCK = np.dtype(
    [
        (name, "f8", LANES)
        for names in (
            # the state and the constants, in the order of the columns in `scene.springs`
            "place_x place_y base_x base_y branch_x branch_y force_x force_y normal normal_branch",
            "indentation bent path slipped mode speed slid_s earlier",
            "layout_x layout_y gap along bending compliance across shorter",
            # target of the base's motion, and the depth; the tip's place, and its initial stretch
            "to_x to_y deep foot_x foot_y old_x old_y",
            # force along the papilla and the gain of its relaxing branch; soft part across it
            "pressed gain soft",
            # friction behind a knot of the path, and the knot that is needed
            "knot c0 c1 c2 c3 wanted",
            # how the step ends: mode, place, force, bend; slip, and share of the step at which the
            # tip lets go (negative: it does not)
            "end_mode end_x end_y end_force_x end_force_y end_normal end_bent slip share",
            # the search for the bend: bracket, whether it continues (negative: failed), stretch
            "low high seeks stretch",
            # the force when the slip begins, the cone's radii at both ends; the slip's direction
            "from_x from_y before after unit_x unit_y top bottom arc",
            # the search for the slip (`scene.slip.slip_step`)
            "bend ahead aside rest_x rest_y soft_x soft_y quick lag grip grip_slope far",
            # for lanes that are prepared one by one: kind, share of the drive until the tip lets
            # go, how long it slides then (s), the force that the plate loses by its letting go
            "rare held slides_s kick",
        )
        for name in names.split()
    ]
)
"""A block of tips: a row of lanes for each quantity. A processor computes four or eight numbers at
once if they lie next to each other and if it is known beforehand how many there are."""
Block = np.record
Blocks = npt.NDArray[np.record]
"""As kernels see one of them, and several."""
_ROWS, _STATES, _CONSTANTS = len(BLOCK.names or ()), 18, 8
_AWAY_MM = 1e6
_LETS_GO, _SLOWS = 1.0, 2.0
"""Kinds of rare slips: a tip that lets go, and one without a usable speed history."""
ROUNDING = 1.0 + 1e-13
"""A force this little over its limit is rounding, not slip: a tip at rest stays to the bit."""


class ContactStep(NamedTuple):
    """A step of the solver in which sensor and plate move linearly."""

    h: float
    """Its length, s."""
    decay: float
    """Of the relaxing branch over the step, and its gain for linear motion (`relaxing`)."""
    gain: float
    swerve: float
    """The base's speed along y at the end of the step over its mean one, mm/s: it changes
    linearly where the plate falls."""


@njit(cache=True, nogil=True, error_model="numpy")
def make_blocks(table: F64, field: F64, state: F64) -> Blocks:
    """Blocks for n tips, (ceil(n / LANES),); lanes left over hold papillae out of reach."""
    n = state.shape[0]
    blocks = np.zeros((n + LANES - 1) // LANES, BLOCK)
    flat = blocks.view(np.float64)
    for k in range(blocks.shape[0]):
        w = blocks[k]
        for j in range(LANES):
            w.mode[j], w.gap[j] = FREE, _AWAY_MM
        for i in range(k * LANES, min(n, (k + 1) * LANES)):
            j = i - k * LANES
            for c in range(_STATES):
                flat[(k * _ROWS + c) * LANES + j] = state[i, c]
            for c in range(_CONSTANTS):
                flat[(k * _ROWS + _STATES + c) * LANES + j] = table[i, c]
            _take_knot(w, field, i, j, knot_at(state[i, of.PATH]))
    return blocks


@njit(cache=True, nogil=True, error_model="numpy")
def store_state(blocks: Blocks, state: F64) -> None:
    """Write the state of the tips in `blocks` back into one row each, (n, 18)."""
    flat = blocks.view(np.float64)
    for i in range(state.shape[0]):
        for c in range(_STATES):
            state[i, c] = flat[(i // LANES * _ROWS + c) * LANES + i % LANES]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _take_knot(w: Block, field: F64, i: int, j: int, knot: float) -> None:
    """Let lane `j` hold the friction of tip `i` behind a knot."""
    w.knot[j] = knot
    w.c0[j], w.c1[j], w.c2[j], w.c3[j] = cubic_at(field, i, knot)


@njit(cache=True, nogil=True, error_model="numpy")
def feel_spots(blocks: Blocks, n: int, clean: F64, field: F64, spots: F64, factors: F64) -> None:
    """Apply the friction of the spots under the tips at the beginning of a step.

    It is constant during the step, so a tip feels a spot's border a step late: a few
    micrometres on the way.

    Args:
        clean: friction outside all spots, as `Springs.friction`.
        field: friction as it is felt; rows of the tips that came to another place are written.
        spots: of `Springs`, (k, 4).
        factors: by which each row of `field` differs from `clean`, (n,), written.
    """
    for i in range(n):
        w, j = blocks[i // LANES], i % LANES
        factor = spot_factor(w.place_x[j], w.place_y[j], spots)
        if factor != factors[i]:
            factors[i] = factor
            for k in range(field.shape[1]):
                for c in range(field.shape[2]):
                    field[i, k, c] = clean[i, k, c] * factor
            _take_knot(w, field, i, j, w.knot[j])


# -- a step of a block -----------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def respond(
    w: Block,
    field: F64,
    law: Law,
    first: int,
    count: int,
    sensor: F64,
    plate_y: float,
    step: ContactStep,
) -> None:
    """Find how a block's tips end a step; the state stays.

    Args:
        w: a block.
        first, count: the block's first tip, and how many it has.
        sensor: x, y, depth (mm) at the end of the step, and the two slopes of depth, (5,); if the
            sensor turns about the plate's normal its angle, rad, is a sixth number.
        plate_y: height of the plate at the end of the step, mm.
        step: `ContactStep`.
    """
    turn = sensor[5] if sensor.shape[0] > 5 else 0.0
    stale, touching = _approach(
        w,
        law,
        sensor[0],
        sensor[1],
        sensor[2],
        sensor[3],
        sensor[4],
        np.cos(turn),
        np.sin(turn),
        plate_y,
        step,
    )
    if stale > 0:
        for j in range(count):
            if w.wanted[j] != w.knot[j]:
                _take_knot(w, field, first + j, j, w.wanted[j])
    if touching > 0:
        for j in range(count):
            if w.mode[j] == FREE and w.deep[j] > 0.0:
                _touch(w, law, j, step)
    for _ in range(ITERATIONS):
        if _bend(w) == 0:
            break
    if law.creep_mm_s > 0.0 and _creep(w, law, count, step) > 0:
        for _ in range(ITERATIONS):
            if _bend(w) == 0:
                break
    slides, rare = _decide(w, law, step)
    if slides > 0:
        _slide(w, field, law, first, count, step, rare)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _approach(
    w: Block,
    law: Law,
    x: float,
    y: float,
    depth: float,
    slope_x: float,
    slope_y: float,
    cosine: float,
    sine: float,
    plate_y: float,
    step: ContactStep,
) -> tuple[int, int]:
    """Move the bases, and begin to seek the bends.

    Returns:
        how many tips need another knot, and how many meet the plate in this step.
    """
    stale, touching = 0, 0
    for j in range(LANES):
        lx, ly = w.layout_x[j], w.layout_y[j]
        # without a turn these are x + lx and y + ly to the bit
        w.to_x[j] = x + (cosine * lx - sine * ly)
        w.to_y[j] = y + (cosine * ly + sine * lx) - plate_y
        away_x, away_y = w.to_x[j], w.to_y[j]
        bulge = 0.5 * law.curvature * (away_x * away_x + away_y * away_y)
        deep = depth + slope_x * lx + slope_y * ly - w.gap[j] - bulge
        w.deep[j] = deep
        place_x, place_y = w.place_x[j], w.place_y[j]
        w.foot_x[j], w.foot_y[j] = place_x, place_y
        w.old_x[j], w.old_y[j] = w.base_x[j] - place_x, w.base_y[j] - place_y
        _load(w, law, j, step.h, step.decay, step.gain)
        wanted = knot_at(w.path[j])
        w.wanted[j] = wanted
        stale += 1 if wanted != w.knot[j] else 0
        touching += 1 if w.mode[j] == FREE and deep > 0.0 else 0
    return stale, touching


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _load(w: Block, law: Law, j: int, h: float, decay: float, gain: float) -> None:
    """Press a tip, and begin to seek the bend that it has if it sticks."""
    along, was, deep = w.along[j], w.indentation[j], w.deep[j]
    was = was if was > 0.0 else 0.0
    soft = law.maxwell * gain + law.damping_s / h
    pressed = along * deep + w.normal_branch[j] * decay + law.maxwell * along * gain * (deep - was)
    new_x, new_y = w.to_x[j] - w.foot_x[j], w.to_y[j] - w.foot_y[j]
    stretch = np.sqrt(new_x * new_x + new_y * new_y)
    w.end_bent[j] = first_bend(stretch, w.bent[j], w.bending[j], w.shorter[j], w.compliance[j])
    w.low[j], w.high[j], w.stretch[j] = 0.0, stretch, stretch
    w.pressed[j], w.gain[j], w.soft[j] = pressed, gain, w.across[j] * soft
    w.seeks[j] = 1.0 if deep > 0.0 and pressed > 0.0 else 0.0


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _touches_at(was: float, deep: float) -> float:
    """Share of a step at which a tip meets the plate; 1 if where it came from is not known."""
    return was / (was - deep) if was < 0.0 else 1.0


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(w: Block, law: Law, j: int, step: ContactStep) -> None:
    """Place a tip that meets the plate in this step under its base at that moment."""
    was, gain = w.indentation[j], step.gain
    w.foot_x[j], w.foot_y[j] = w.to_x[j], w.to_y[j]
    if was < 0.0:
        share = _touches_at(was, w.deep[j])
        w.foot_x[j] = w.base_x[j] + share * (w.to_x[j] - w.base_x[j])
        w.foot_y[j] = w.base_y[j] + share * (w.to_y[j] - w.base_y[j])
        gain = relaxing((1.0 - share) * step.h, law.relaxation_s)[1]
    w.old_x[j], w.old_y[j] = 0.0, 0.0
    _load(w, law, j, step.h, step.decay, gain)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _bend(w: Block) -> int:
    """Take a step of every tip towards its bend if it sticks; return how many have not found it."""
    seek = 0
    for j in range(LANES):
        seeks = w.seeks[j] > 0.0
        bent, low, high, found = bend_step(
            w.end_bent[j],
            w.low[j],
            w.high[j],
            w.stretch[j],
            w.bending[j],
            w.shorter[j],
            w.compliance[j],
            w.pressed[j],
            w.along[j],
        )
        w.end_bent[j] = bent if seeks else w.end_bent[j]
        w.low[j], w.high[j] = low, high
        still = seeks and not found
        w.seeks[j] = 1.0 if still else 0.0
        seek += 1 if still else 0
    return seek


@njit(cache=True, nogil=True, error_model="numpy")
def _creep(w: Block, law: Law, count: int, step: ContactStep) -> int:
    """Move the tips that stick as far as they creep; return how many seek another bend."""
    crept, static = 0, 1.0 + law.static_excess
    for j in range(count):
        if w.mode[j] != STUCK or not (w.deep[j] > 0.0 and w.pressed[j] > 0.0):
            continue
        new_x, new_y = w.to_x[j] - w.foot_x[j], w.to_y[j] - w.foot_y[j]
        soft, stretch = w.soft[j], w.stretch[j]
        force, normal, slope, _ = column(
            w.end_bent[j], w.bending[j], w.shorter[j], w.pressed[j], w.along[j]
        )
        secant = force / stretch if stretch > 0.0 else 0.0
        x = secant * new_x + w.branch_x[j] * step.decay + soft * (new_x - w.old_x[j])
        y = secant * new_y + w.branch_y[j] * step.decay + soft * (new_y - w.old_y[j])
        y += w.across[j] * law.damping_s * step.swerve
        end, start = np.sqrt(x * x + y * y), np.sqrt(w.force_x[j] ** 2 + w.force_y[j] ** 2)
        if end == 0.0:
            continue
        grip, _ = grip_between(w.path[j], w.knot[j], w.c0[j], w.c1[j], w.c2[j], w.c3[j])
        limit = static * grip
        steepness = slope / (1.0 + w.compliance[j] * slope) + soft
        slip = creep_slip(start, end, limit * w.normal[j], limit * normal, steepness, step.h, law)
        w.foot_x[j] += slip * x / end
        w.foot_y[j] += slip * y / end
        _load(w, law, j, step.h, step.decay, step.gain)
        crept += 1
    return crept


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _decide(w: Block, law: Law, step: ContactStep) -> tuple[int, int]:
    """Find the forces if all tips stick, and which tips do.

    Returns:
        how many slide, and how many of these need to be prepared one by one.
    """
    slide, rare = 0, 0
    static = 1.0 + law.static_excess
    for j in range(LANES):
        new_x, new_y = w.to_x[j] - w.foot_x[j], w.to_y[j] - w.foot_y[j]
        moved_x, moved_y = new_x - w.old_x[j], new_y - w.old_y[j]
        soft, bent, stretch = w.soft[j], w.end_bent[j], w.stretch[j]
        force, normal, _, _ = column(bent, w.bending[j], w.shorter[j], w.pressed[j], w.along[j])
        secant = force / stretch if stretch > 0.0 else 0.0
        damp = w.across[j] * law.damping_s
        trial_x = secant * new_x + w.branch_x[j] * step.decay + soft * moved_x
        trial_y = secant * new_y + w.branch_y[j] * step.decay + soft * moved_y + damp * step.swerve
        grip, _ = grip_between(w.path[j], w.knot[j], w.c0[j], w.c1[j], w.c2[j], w.c3[j])
        from_x, from_y = w.force_x[j], w.force_y[j]
        before, after = grip * w.normal[j], grip * normal
        keeps_on = w.mode[j] == SLIDING and keeps_sliding(
            from_x, from_y, trial_x - from_x, trial_y - from_y, before, after, law.strengthening
        )
        limit = after * (1.0 if keeps_on else static)
        size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
        free = not (w.deep[j] > 0.0 and w.pressed[j] > 0.0)
        slides = not free and not size <= limit * ROUNDING
        slows = slows_down(w.slid_s[j], w.speed[j], from_x, from_y, moved_x, moved_y, step.h, law)
        kind = _LETS_GO if not keeps_on else (_SLOWS if slows else 0.0)
        kind = kind if slides else 0.0
        end = SLIDING if slides else STUCK
        w.end_mode[j] = FREE if free else end
        w.end_x[j], w.end_y[j] = (
            w.to_x[j] if free else w.foot_x[j],
            w.to_y[j] if free else w.foot_y[j],
        )
        w.end_force_x[j], w.end_force_y[j] = 0.0 if free else trial_x, 0.0 if free else trial_y
        w.end_normal[j], w.end_bent[j] = 0.0 if free else normal, 0.0 if free else bent
        w.slip[j], w.share[j], w.rare[j] = 0.0, -1.0, kind
        w.from_x[j], w.from_y[j] = from_x, from_y
        w.before[j], w.after[j] = raised_cone(from_x, from_y, before, after)
        w.seeks[j] = 1.0 if slides else 0.0
        slide += 1 if slides else 0
        rare += 1 if kind > 0.0 else 0
    return slide, rare


@njit(cache=True, nogil=True, error_model="numpy")
def settle(w: Block, law: Law, start_s: float, h: float, decay: float) -> None:
    """Take what `respond` found as the state; `start_s`: when the step began, s."""
    for j in range(LANES):
        end, deep = w.end_mode[j], w.deep[j]
        clear = end == FREE
        x, y, to_x, to_y = w.end_x[j], w.end_y[j], w.to_x[j], w.to_y[j]
        along, was = w.along[j], w.indentation[j]
        was = was if was > 0.0 else 0.0
        soft = law.maxwell * w.gain[j]
        pressed = w.normal_branch[j] * decay + soft * along * (deep - was)
        w.normal_branch[j] = -along * max(deep, 0.0) if clear else pressed
        soft *= w.across[j]
        branch_x = w.branch_x[j] * decay + soft * (to_x - x - w.old_x[j])
        branch_y = w.branch_y[j] * decay + soft * (to_y - y - w.old_y[j])
        w.branch_x[j], w.branch_y[j] = 0.0 if clear else branch_x, 0.0 if clear else branch_y
        w.indentation[j], w.mode[j] = deep, end
        w.base_x[j], w.base_y[j], w.place_x[j], w.place_y[j] = to_x, to_y, x, y
        w.force_x[j], w.force_y[j] = w.end_force_x[j], w.end_force_y[j]
        w.normal[j], w.bent[j] = w.end_normal[j], w.end_bent[j]
        slip, share = w.slip[j], w.share[j]
        w.slipped[j] = start_s + share * h if share >= 0.0 else w.slipped[j]
        part = h * (1.0 - max(share, 0.0))
        speed, earlier = slip / part if slip > 0.0 else 0.0, w.speed[j]
        # a tip that just let go, or slows down fast, differs from its state a step ago
        steady = slip > 0.0 and share < 0.0 and is_steady(earlier, speed)
        rests = law.least_mm_s > 0.0 and w.quick[j] * slip + w.lag[j] < law.least_mm_s
        if end == SLIDING and rests:
            w.mode[j], speed, steady = STUCK, 0.0, False
        w.earlier[j] = earlier if steady and w.slid_s[j] == h else -1.0
        w.slid_s[j], w.speed[j] = h if steady else 0.0, speed
        w.path[j] += slip


# -- sliding ---------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _slide(
    w: Block, field: F64, law: Law, first: int, count: int, step: ContactStep, rare: int
) -> None:
    """Slide the tips with `end_mode` sliding; `rare`: how many are prepared one by one."""
    rough = field.shape[1] > 1
    if rare > 0:
        for j in range(count):
            if w.rare[j] == _LETS_GO:
                _let_go(w, law, j, step)
    _aim(w, law)
    _begin(w, law, rough, step)
    if rare > 0:
        for j in range(count):
            if w.rare[j] > 0.0:
                _begin_rare(w, field, law, first + j, j, rough, step)
    _search(w, field, law, first, count)
    if rare > 0:
        again = 0
        for j in range(count):
            if w.seeks[j] > 0.0:
                w.seeks[j] = -1.0  # no more passes for slips not found by now
            elif w.rare[j] == _LETS_GO and w.seeks[j] == 0.0:
                again += _speed_at_end(w, field, law, first + j, j)
        if again > 0:
            _search(w, field, law, first, count)
    if _doubtful(w) > 0:
        for j in range(count):
            if w.end_mode[j] == SLIDING and (w.seeks[j] != 0.0 or w.slip[j] > w.far[j]):
                w.slip[j], w.bend[j] = march_to_slip(
                    w.end_bent[j],
                    w.ahead[j],
                    w.aside[j],
                    w.rest_x[j],
                    w.rest_y[j],
                    w.soft_x[j],
                    w.soft_y[j],
                    w.pressed[j],
                    w.along[j],
                    w.bending[j],
                    w.shorter[j],
                    w.compliance[j],
                    field,
                    first + j,
                    w.path[j],
                    w.quick[j],
                    w.lag[j],
                    law,
                )
    if _arrive(w) > 0:
        for j in range(count):
            if w.end_mode[j] == SLIDING and w.wanted[j] != w.knot[j]:
                _take_knot(w, field, first + j, j, w.wanted[j])
    _pull(w, law)
    if rare > 0:
        for j in range(count):
            if w.rare[j] == _LETS_GO:
                w.kick[j] -= w.held[j] * w.end_force_y[j]


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _aim(w: Block, law: Law) -> None:
    """Find the directions of the slips."""
    if law.exact_turns:
        for j in range(LANES):
            from_x, from_y = w.from_x[j], w.from_y[j]
            w.unit_x[j], w.unit_y[j], w.top[j], w.bottom[j], w.arc[j] = tractrix(
                from_x,
                from_y,
                w.end_force_x[j] - from_x,
                w.end_force_y[j] - from_y,
                w.before[j],
                w.after[j],
            )
        for j in range(LANES):
            unit_x, unit_y = tractrix_end(w.unit_x[j], w.unit_y[j], w.top[j], w.bottom[j], w.arc[j])
            w.unit_x[j], w.unit_y[j] = slip_direction(
                w.from_x[j],
                w.from_y[j],
                w.end_force_x[j],
                w.end_force_y[j],
                unit_x,
                unit_y,
                w.after[j],
            )
    else:
        for j in range(LANES):
            trial_x, trial_y = w.end_force_x[j], w.end_force_y[j]
            size = np.sqrt(trial_x * trial_x + trial_y * trial_y)
            w.unit_x[j], w.unit_y[j] = trial_x / size, trial_y / size


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _begin(w: Block, law: Law, rough: bool, step: ContactStep) -> None:
    """Begin the search of every slip where its earlier speeds lead."""
    per_s = 1.0 / step.h
    for j in range(LANES):
        quick, lag, slides = predicted_speed(step.h, per_s, w.slid_s[j], w.speed[j], w.earlier[j])
        _begin_search(w, law, j, quick, lag, slides, rough, per_s, step)


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _begin_search(
    w: Block,
    law: Law,
    j: int,
    quick: float,
    lag: float,
    slides: float,
    rough: bool,
    per_s: float,
    step: ContactStep,
) -> None:
    """Begin to seek a slip, given the speed at its end (see `strengthened`) and a guess of it."""
    new_x, new_y = w.to_x[j] - w.foot_x[j], w.to_y[j] - w.foot_y[j]
    old_x, old_y = w.old_x[j], w.old_y[j]
    unit_x, unit_y = w.unit_x[j], w.unit_y[j]
    (
        w.ahead[j],
        w.aside[j],
        w.rest_x[j],
        w.rest_y[j],
        w.soft_x[j],
        w.soft_y[j],
    ) = along_slip(
        new_x,
        new_y,
        old_x,
        old_y,
        w.branch_x[j] * step.decay,
        w.branch_y[j] * step.decay,
        w.across[j] * law.maxwell * w.gain[j],
        w.across[j] * law.damping_s,
        per_s,
        step.swerve,
        unit_x,
        unit_y,
        quick,
        lag,
    )
    slip, w.bend[j], w.far[j] = first_slip(
        new_x - old_x,
        new_y - old_y,
        unit_x,
        unit_y,
        slides,
        w.bent[j],
        w.bending[j],
        w.shorter[j],
        w.compliance[j],
        w.pressed[j],
        w.along[j],
        rough,
    )
    w.slip[j] = slip if w.seeks[j] > 0.0 else 0.0
    w.quick[j], w.lag[j] = quick, lag


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _search(w: Block, field: F64, law: Law, first: int, count: int) -> None:
    """Seek the slips of all lanes that are seeking; `seeks` is then 0 where one is found."""
    for _ in range(PASSES):
        stale = 0
        for j in range(LANES):
            wanted = knot_at(w.path[j] + w.slip[j])
            w.wanted[j] = wanted
            stale += 1 if w.seeks[j] > 0.0 and wanted != w.knot[j] else 0
        if stale > 0:
            for j in range(count):
                if w.seeks[j] > 0.0 and w.wanted[j] != w.knot[j]:
                    _take_knot(w, field, first + j, j, w.wanted[j])
        if _seek(w, law) == 0:
            break


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _seek(w: Block, law: Law) -> int:
    """Take a step of every tip towards its slip; return how many are still searching."""
    seek = 0
    for j in range(LANES):
        slip = w.slip[j]
        grip, grip_slope = grip_between(
            w.path[j] + slip, w.knot[j], w.c0[j], w.c1[j], w.c2[j], w.c3[j]
        )
        w.grip[j], w.grip_slope[j] = strengthened(grip, grip_slope, slip, w.quick[j], w.lag[j], law)
    for j in range(LANES):
        seeks = w.seeks[j] > 0.0
        slip, bend, found, hopeful, _ = slip_step(
            w.slip[j],
            w.bend[j],
            w.ahead[j],
            w.aside[j],
            w.rest_x[j],
            w.rest_y[j],
            w.soft_x[j],
            w.soft_y[j],
            w.pressed[j],
            w.along[j],
            w.bending[j],
            w.shorter[j],
            w.compliance[j],
            w.grip[j],
            w.grip_slope[j],
            w.quick[j],
            law.weak_mm_s,
        )
        w.slip[j], w.bend[j] = slip if seeks else w.slip[j], bend if seeks else w.bend[j]
        still = seeks and hopeful and not found
        ended = -1.0 if seeks and not hopeful else (0.0 if seeks else w.seeks[j])
        w.seeks[j] = 1.0 if still else ended
        seek += 1 if still else 0
    return seek


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _doubtful(w: Block) -> int:
    """Count the slips that were not found, or jump too far to be believed."""
    doubts = 0
    for j in range(LANES):
        slides = w.end_mode[j] == SLIDING
        doubts += 1 if slides and (w.seeks[j] != 0.0 or w.slip[j] > w.far[j]) else 0
    return doubts


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _arrive(w: Block) -> int:
    """Move the tips that slid to their places; return how many need another knot."""
    stale = 0
    for j in range(LANES):
        slides, slip = w.end_mode[j] == SLIDING, w.slip[j]
        wanted = knot_at(w.path[j] + slip)
        w.end_x[j] = w.foot_x[j] + slip * w.unit_x[j] if slides else w.end_x[j]
        w.end_y[j] = w.foot_y[j] + slip * w.unit_y[j] if slides else w.end_y[j]
        w.end_bent[j] = w.bend[j] if slides else w.end_bent[j]
        w.wanted[j] = wanted
        stale += 1 if slides and wanted != w.knot[j] else 0
    return stale


@njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _pull(w: Block, law: Law) -> None:
    """Find the forces of the tips that slid: on the cone at the end of the slip, to the bit."""
    for j in range(LANES):
        slides, slip = w.end_mode[j] == SLIDING, w.slip[j]
        force_x, force_y, normal = force_after(
            slip,
            w.end_bent[j],
            w.ahead[j],
            w.aside[j],
            w.rest_x[j],
            w.rest_y[j],
            w.soft_x[j],
            w.soft_y[j],
            w.pressed[j],
            w.along[j],
            w.bending[j],
            w.shorter[j],
        )
        grip, _ = grip_between(w.path[j] + slip, w.knot[j], w.c0[j], w.c1[j], w.c2[j], w.c3[j])
        grip, _ = strengthened(grip, 0.0, slip, w.quick[j], w.lag[j], law)
        x, y = onto_cone(force_x, force_y, w.unit_x[j], w.unit_y[j], grip * normal)
        w.end_force_x[j] = x if slides else w.end_force_x[j]
        w.end_force_y[j] = y if slides else w.end_force_y[j]
        w.end_normal[j] = normal if slides else w.end_normal[j]


# -- letting go, lane by lane ----------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def _let_go(w: Block, law: Law, j: int, step: ContactStep) -> None:
    """Find when in the step a tip lets go, and with which force its slip begins."""
    grip, _ = grip_between(w.path[j], w.knot[j], w.c0[j], w.c1[j], w.c2[j], w.c3[j])
    static, before, after = 1.0 + law.static_excess, grip * w.normal[j], grip * w.end_normal[j]
    from_x, from_y = w.force_x[j], w.force_y[j]
    drive_x, drive_y = w.end_force_x[j] - from_x, w.end_force_y[j] - from_y
    share = leaves_cone_at(from_x, from_y, drive_x, drive_y, static * before, after * static)
    if w.mode[j] == STUCK and w.indentation[j] > 0.0 and 0.0 < share < 1.0:
        share = _lets_go_at(share, w, law, j, static * grip, step)
    from_x, from_y = from_x + share * drive_x, from_y + share * drive_y
    before += share * (after - before)
    w.from_x[j], w.from_y[j], w.before[j], w.after[j] = from_x, from_y, before, after
    touched = _touches_at(w.indentation[j], w.deep[j]) if w.mode[j] == FREE else 0.0
    w.share[j], w.held[j] = touched + (1.0 - touched) * share, share
    w.slides_s[j] = (1.0 - share) * (1.0 - touched) * step.h
    # up to where it lets go the force goes from one end to `from`, then from what is left of that
    retained = force_kept(
        np.sqrt(from_x * from_x + from_y * from_y), before, w.across[j] * law.damping_s, law
    )
    w.kick[j] = from_y * (share + (1.0 - share) * retained) - (1.0 - share) * w.force_y[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _lets_go_at(guess: float, w: Block, law: Law, j: int, limit: float, step: ContactStep) -> float:
    """Share of a step at which a stuck tip's force meets its cone: a root of the law itself.

    While a tip sticks its force is a known function of time, relaxation included, so that the
    slip is located exactly in steps of any length (regula falsi, Illinois).
    """
    low, high = 0.0, 1.0
    below, above = _excess(low, w, law, j, limit, step), _excess(high, w, law, j, limit, step)
    if below >= 0.0 or above <= 0.0:
        return guess
    share, side = guess, 0
    for _ in range(ITERATIONS):
        if not low < share < high:
            share = 0.5 * (low + high)
        miss = _excess(share, w, law, j, limit, step)
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
def _excess(share: float, w: Block, law: Law, j: int, limit: float, step: ContactStep) -> float:
    """Force less `limit` times normal force of a tip that has stuck up to a share of a step, N."""
    h, swerve = step.h, step.swerve
    decay, gain = relaxing(max(share * h, 1e-12), law.relaxation_s)
    new_x, new_y = w.to_x[j] - w.foot_x[j], w.to_y[j] - w.foot_y[j]
    old_x, old_y = w.old_x[j], w.old_y[j]
    move_x, move_y = share * (new_x - old_x), share * (new_y - old_y)
    move_y -= swerve * h * share * (1.0 - share)
    x, y = old_x + move_x, old_y + move_y
    along, was = w.along[j], w.indentation[j]
    bending, shortening = w.bending[j], w.shorter[j]
    sunk = share * (w.deep[j] - was)
    pressed = along * (was + sunk) + w.normal_branch[j] * decay + law.maxwell * along * gain * sunk
    stretch = np.sqrt(x * x + y * y)
    bent = bend_for(stretch, w.bent[j], bending, shortening, w.compliance[j], pressed, along)
    force, normal, _, _ = column(bent, bending, shortening, pressed, along)
    secant = force / stretch if stretch > 0.0 else 0.0
    soft, damp = w.across[j] * law.maxwell * gain, w.across[j] * law.damping_s
    rate_x, rate_y = (new_x - old_x) / h, (new_y - old_y) / h + swerve * (2.0 * share - 1.0)
    fx = secant * x + w.branch_x[j] * decay + soft * move_x + damp * rate_x
    fy = secant * y + w.branch_y[j] * decay + soft * move_y + damp * rate_y
    return np.sqrt(fx * fx + fy * fy) - limit * normal


@njit(cache=True, nogil=True, error_model="numpy")
def _begin_rare(
    w: Block, field: F64, law: Law, i: int, j: int, rough: bool, step: ContactStep
) -> None:
    """Begin to seek the slip of tip `i` in lane `j`, which lets go or slows down fast."""
    before, after = w.before[j], w.after[j]
    if w.rare[j] == _LETS_GO:
        # it slips as far as its base moves from then on
        slides_s = w.slides_s[j]
        quick = 1.0 / slides_s if slides_s > 0.0 else 0.0
        moved_x = w.to_x[j] - w.foot_x[j] - w.old_x[j]
        moved_y = w.to_y[j] - w.foot_y[j] - w.old_y[j]
        slides = (1.0 - w.held[j]) * (moved_x * w.unit_x[j] + moved_y * w.unit_y[j])
        _begin_search(w, law, j, quick, 0.0, slides, rough, 1.0 / step.h, step)
    else:
        w.slides_s[j] = step.h
        grip, _ = grip_at(field, i, w.path[j])
        before, after = grip * w.normal[j], grip * w.end_normal[j]
    if _needs_speed(law, before, w.slides_s[j]):
        first = np.sqrt(w.from_x[j] * w.from_x[j] + w.from_y[j] * w.from_y[j])
        _take_speed(
            w,
            field,
            law,
            i,
            j,
            0.0,
            w.end_bent[j],
            before,
            after,
            0.5 * (before + after),
            first / before,
        )


@njit(cache=True, nogil=True, error_model="numpy")
def _needs_speed(law: Law, cone: float, slides_s: float) -> bool:
    """Return whether the speed of a rare slip follows from how its force relaxes."""
    return law.strengthening > 0.0 and law.damping_s == 0.0 and cone > 0.0 and slides_s > 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _speed_at_end(w: Block, field: F64, law: Law, i: int, j: int) -> int:
    """Recompute the speed of a tip that let go: it soon equals that at the end of its slip.

    Returns:
        1 if there is a new speed, and the slip is sought again; else 0.
    """
    if not _needs_speed(law, w.before[j], w.slides_s[j]):
        return 0
    slip, bend = w.slip[j], w.bend[j]
    _, normal, _, _ = column(bend, w.bending[j], w.shorter[j], w.pressed[j], w.along[j])
    grip, _ = grip_at(field, i, w.path[j] + slip)
    more, _ = strengthened(1.0, 0.0, slip, w.quick[j], w.lag[j], law)
    _take_speed(w, field, law, i, j, slip, bend, w.before[j], w.after[j], grip * normal, more)
    w.seeks[j] = 1.0
    return 1


@njit(cache=True, nogil=True, error_model="numpy")
def _take_speed(
    w: Block,
    field: F64,
    law: Law,
    i: int,
    j: int,
    slip: float,
    bend: float,
    before: float,
    after: float,
    cone: float,
    more: float,
) -> None:
    """Take the speed at the end of a slip from `relaxed_speed`.

    Args:
        slip, bend: a state during the slip, mm; cone: the cone's radius there, N; more: what speed
            multiplies friction by there.
        before, after: the cone's radii at both ends if the tip does not slip, N.
    """
    grip, slope = grip_at(field, i, w.path[j] + slip)
    _, _, _, _, steepness = slip_step(
        slip,
        bend,
        w.ahead[j],
        w.aside[j],
        w.rest_x[j],
        w.rest_y[j],
        w.soft_x[j],
        w.soft_y[j],
        w.pressed[j],
        w.along[j],
        w.bending[j],
        w.shorter[j],
        w.compliance[j],
        grip * more,
        slope * more,
        0.0,
        law.weak_mm_s,
    )
    first = np.sqrt(w.from_x[j] * w.from_x[j] + w.from_y[j] * w.from_y[j])
    x, y = w.end_force_x[j], w.end_force_y[j]
    speed = relaxed_speed(
        first, np.sqrt(x * x + y * y) - first, before, after, cone, steepness, w.slides_s[j], law
    )
    if speed >= 0.0:
        w.quick[j], w.lag[j] = 0.0, speed


# -- many steps ------------------------------------------------------------------------------


@njit(cache=True, nogil=True, error_model="numpy")
def move_tips(
    blocks: Blocks,
    n: int,
    field: F64,
    law: Law,
    sensor: F64,
    plate_y: float,
    start_s: float,
    step: ContactStep,
) -> None:
    """Advance every tip by one step; `start_s`: when it begins, s; see `respond`."""
    for k in range(blocks.shape[0]):
        first = k * LANES
        respond(blocks[k], field, law, first, min(n - first, LANES), sensor, plate_y, step)
        settle(blocks[k], law, start_s, step.h, step.decay)


@njit(cache=True, nogil=True, error_model="numpy")
def record(blocks: Blocks, n: int, plate_y: float, track: F64, load: F64) -> None:
    """Write the state into a row of `track` (see `track_width`) and of `load` if that has room."""
    for k in range(blocks.shape[0]):
        w, first = blocks[k], k * LANES
        for j in range(min(n - first, LANES)):
            i = first + j
            track[2 * i], track[2 * i + 1] = w.place_x[j], w.place_y[j]
            track[2 * n + i], track[3 * n + i] = w.path[j], w.slipped[j]
        if load.shape[0] == 3 * n:
            for j in range(min(n - first, LANES)):
                i = 3 * (first + j)
                load[i], load[i + 1], load[i + 2] = w.force_x[j], w.force_y[j], w.normal[j]
    track[4 * n] = plate_y


@njit(cache=True, nogil=True, error_model="numpy")
def advance(
    table: F64,
    friction: F64,
    law: Law,
    state: F64,
    t_ns: I64,
    sensor: F64,
    plate_y: F64,
    track: F64,
    load: F64,
    spots: F64,
) -> None:
    """Advance tips from row to row with the plate where it is prescribed.

    Args:
        table, friction, law: of `Springs`; state: of `Tips`, written.
        t_ns: when the first step begins and when each ends, rising, int64, (m + 1,).
        sensor: x, y, depth (mm) and the two slopes of depth at the end of each step, (m, 5); and
            its angle about the plate's normal, rad, if it turns, (m, 6).
        plate_y: height of the plate, mm: before the first step, and after each, (m + 1,).
        track: filled with one row a step, (m, track_width(n)).
        load: tangential force x, y and normal force of each tip, N, (m, 3 n); or (m, 0).
        spots: of `Springs`, (k, 4).
    """
    n, blocks = state.shape[0], make_blocks(table, friction, state)
    field, factors = friction, np.ones(n)
    if spots.shape[0] > 0:
        field = friction.copy()
    step_ns, step = np.int64(0), ContactStep(0.0, 1.0, 1.0, 0.0)
    for k in range(sensor.shape[0]):
        if t_ns[k + 1] - t_ns[k] != step_ns:
            step_ns = t_ns[k + 1] - t_ns[k]
            h = step_ns * 1e-9
            decay, gain = relaxing(h, law.relaxation_s)
            step = ContactStep(h, decay, gain, 0.0)
        if spots.shape[0] > 0:
            feel_spots(blocks, n, friction, field, spots, factors)
        move_tips(blocks, n, field, law, sensor[k], plate_y[k + 1], t_ns[k] * 1e-9, step)
        record(blocks, n, plate_y[k + 1], track[k], load[k])
    store_state(blocks, state)
