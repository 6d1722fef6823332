"""Sliding where the direction turns, turned and mirrored scenes, and what friction may not do."""

import itertools
import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.scene.skin import SkinGeometry, make_skin
from sliplab.plugins.simulation.scene.springs import SLIDING, Springs, new_tips
from tests.plugins.simulation.scene.steps import (
    MU,
    RICH,
    ideal_skin,
    line,
    pressed,
    rough,
    run,
    springs_of,
)

LEVELS = pytest.mark.parametrize("level", [1, 2, 3])


def sliding_along_x(springs: Springs):
    """Tips that slide steadily along x."""
    tips = pressed(springs)
    run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 100))
    assert np.all(tips.mode == SLIDING)
    return tips


@pytest.mark.parametrize("turn_deg", [5, 45, 90])
@pytest.mark.parametrize("steps", [1, 3, 200])
def test_a_turn_follows_the_tractrix_exactly_whatever_the_step(turn_deg: int, steps: int) -> None:
    springs = springs_of(ideal_skin(), level=1)
    tips = sliding_along_x(springs)
    radius = MU * tips.normal / springs.tangential
    turn = math.radians(turn_deg)
    end = (15 + 2 * math.cos(turn), 2 * math.sin(turn), 2.8)
    run(springs, tips, line((15, 0, 2.8), end, steps))
    angle = np.arctan2(tips.force[:, 1], tips.force[:, 0])
    exact = turn - 2 * np.arctan(np.tan(turn / 2) * np.exp(-2.0 / radius))
    assert angle == pytest.approx(exact, abs=1e-12)
    dragged = tips.base - radius[:, None] * np.column_stack([np.cos(exact), np.sin(exact)])
    assert tips.place == pytest.approx(dragged, abs=1e-12)


@pytest.mark.parametrize("turn_deg", [100, 135, 170])
@pytest.mark.parametrize("steps", [1, 7])
def test_a_sharp_turn_sticks_first_and_then_follows_the_tractrix(turn_deg: int, steps: int) -> None:
    springs = springs_of(ideal_skin(), level=1)
    tips = sliding_along_x(springs)
    radius = MU * tips.normal / springs.tangential
    turn, way = math.radians(turn_deg), 16.0
    end = (15 + way * math.cos(turn), way * math.sin(turn), 2.8)
    run(springs, tips, line((15, 0, 2.8), end, steps))
    # the chord through the cone is 2 rho |cos|; beyond it the drag begins at the mirrored angle
    left = way - 2 * radius * abs(math.cos(turn))
    assert np.all(left > 0)
    theta = 2 * np.arctan(np.tan((math.pi - turn) / 2) * np.exp(-left / radius))
    angle = np.arctan2(tips.force[:, 1], tips.force[:, 0])
    assert angle == pytest.approx(turn - theta, abs=1e-11)


def test_the_drag_of_a_growing_cone_is_exact_too() -> None:
    # rho grows linearly with the way: d theta / ds = -sin(theta) / rho(s), in high precision
    springs = springs_of(ideal_skin(), level=1)
    tips = sliding_along_x(springs)
    turn = math.radians(30)
    rho0 = MU * tips.normal[0] / springs.tangential[0]
    rho1 = MU * springs.normal[0] * 3.2 / springs.tangential[0]
    run(springs, tips, line((15, 0, 2.8), (15 + 2 * math.cos(turn), 2 * math.sin(turn), 3.2), 1))
    mpmath.mp.dps = 30

    def rate(s, y):
        return [-mpmath.sin(y[0]) / (rho0 + (rho1 - rho0) * s / 2)]

    theta = mpmath.odefun(rate, 0, [mpmath.mpf(turn)])(2)[0]
    angle = math.atan2(tips.force[0, 1], tips.force[0, 0])
    assert angle == pytest.approx(turn - float(theta), abs=1e-12)
    assert np.hypot(*tips.force[0]) == pytest.approx(MU * tips.normal[0], rel=1e-13)


def test_a_cone_that_grows_faster_than_the_drive_catches_the_tip_for_a_while() -> None:
    # at a right angle the drive does not take the force outwards at first: the tip sticks until
    # |f0 + s D| = F0 + s (F1 - F0), and follows the tractrix from there
    springs = springs_of(ideal_skin(), level=1)
    tips = sliding_along_x(springs)
    f0, f1 = MU * tips.normal[0], MU * springs.normal[0] * 2.9
    drive = 2.0 * springs.tangential[0]
    leaves = 2 * f0 * (f1 - f0) / (drive**2 - (f1 - f0) ** 2)
    assert 0 < leaves < 1
    run(springs, tips, line((15, 0, 2.8), (15, 2, 2.9), 1), h=1.0)
    assert tips.slipped_s[0] == pytest.approx(leaves, rel=1e-9)
    theta = math.atan2(f0, drive * leaves)
    at_exit = f0 + leaves * (f1 - f0)
    mean = (f1 - at_exit) / math.log(f1 / at_exit)
    theta = 2 * math.atan(math.tan(theta / 2) * math.exp(-drive * (1 - leaves) / mean))
    assert math.atan2(tips.force[0, 0], tips.force[0, 1]) == pytest.approx(theta, abs=1e-12)


def test_projection_is_of_first_order_on_a_turn() -> None:
    springs = springs_of(ideal_skin(), level=1, exact_turns=False)
    errors = []
    for steps in (200, 400, 800):
        tips = sliding_along_x(springs)
        radius = MU * tips.normal / springs.tangential
        run(springs, tips, line((15, 0, 2.8), (15, 2, 2.8), steps))
        angle = np.arctan2(tips.force[:, 0], tips.force[:, 1])
        errors.append(np.abs(angle - 2 * np.arctan(np.exp(-2.0 / radius))).max())
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders == pytest.approx([1.0, 1.0], abs=0.1)


def test_a_hair_of_a_difference_stays_one_where_the_direction_turned() -> None:
    # a search for the slip that stops too early feeds back through the speed of the next step
    skin = ideal_skin()
    springs = rough(skin, 0.05, 1, **RICH)
    forces, paths = [], []
    for hair in (0.0, 1e-12):
        tips = pressed(springs)
        run(springs, tips, line((0, 0, 2.8), (8 + hair, 0, 2.8), 4000), h=2e-3)
        _, load = run(springs, tips, line((8 + hair, 0, 2.8), (12, 5, 2.8), 3000), h=2e-3)
        forces.append(load[:, :, :2])
        paths.append(tips.path.copy())
    assert forces[0] == pytest.approx(forces[1], abs=1e-10)
    assert paths[0] == pytest.approx(paths[1], abs=1e-10)


def driven(springs: Springs, map_of) -> tuple[np.ndarray, np.ndarray]:
    """Places and forces as complex numbers after a crooked way that `map_of` was applied to."""
    tips = pressed(springs)
    corners = [0, 6 + 1j, 5 + 4j, 4.5 - 2j]
    for start, end in itertools.pairwise(corners):
        a, b = complex(map_of(start)), complex(map_of(end))
        run(springs, tips, line((a.real, a.imag, 2.8), (b.real, b.imag, 2.8), 300), h=0.01)
    return tips.place @ [1, 1j], tips.force @ [1, 1j]


@LEVELS
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("turns", [1, 3])
def test_turning_or_mirroring_the_scene_does_so_to_the_result(
    level: int, turns: int, mirror: bool
) -> None:
    springs = springs_of(ideal_skin(), level, **RICH)
    spin = np.exp(1j * math.pi / 3 * turns)

    def moved(z):
        return spin * (np.conj(z) if mirror else z)

    place, force = driven(springs, lambda z: z)
    other_place, other_force = driven(springs, moved)
    layout = springs.layout @ [1, 1j]
    partner = [int(np.abs(layout - moved(spot)).argmin()) for spot in layout]
    assert other_place[partner] == pytest.approx(moved(place), abs=1e-9)
    assert other_force[partner] == pytest.approx(moved(force), abs=1e-9)


WAYPOINT = st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(0.5, 3.4))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 500),
    level=st.sampled_from([1, 2]),
    exact=st.booleans(),
    waypoints=st.lists(WAYPOINT, min_size=2, max_size=5),
    steps=st.sampled_from([5, 40, 200]),
)
def test_friction_never_creates_energy(
    seed: int, level: int, exact: bool, waypoints: list[tuple[float, float, float]], steps: int
) -> None:
    skin = make_skin(SkinGeometry(height_scatter_mm=0.08, friction_scatter=0.05), seed)
    springs = rough(skin, 0.05, seed, level, exact_turns=exact)
    tips, last = new_tips(19), (0.0, 0.0, 0.0)
    for waypoint in waypoints:
        way = line(last, waypoint, steps)
        last = waypoint
        for k in range(steps):
            before, touching = tips.copy(), tips.mode > 0
            run(springs, tips, way[k : k + 1])
            slip = tips.place - before.place
            stayed = touching & (tips.mode > 0)
            lost = np.sum(tips.force * slip, axis=1)[stayed]
            assert np.all(lost >= -1e-14)


def test_work_goes_into_springs_and_friction_and_nowhere_else() -> None:
    """Work done on the bases = energy of the springs + what friction took, at second order."""
    skin = ideal_skin()
    springs = springs_of(skin, level=2)
    misses = []
    for steps in (400, 800, 1600):
        tips = pressed(springs)
        way = line((0, 0, 2.8), (5, 3, 2.2), steps)
        stored, work, lost = energy(springs, tips), 0.0, 0.0
        for k in range(steps):
            before = tips.copy()
            run(springs, tips, way[k : k + 1])
            force = 0.5 * (before.force + tips.force)
            work += float(np.sum(force * (tips.base - before.base)))
            work += float(0.5 * (before.normal + tips.normal).sum() * (2.2 - 2.8) / steps)
            lost += float(np.sum(force * (tips.place - before.place)))
        misses.append(abs(work - (energy(springs, tips) - stored) - lost))
        assert lost > 0.1 * work > 0
    assert misses[-1] < 1e-6
    assert np.log2(misses[0] / misses[2]) / 2 > 1.0


def energy(springs: Springs, tips) -> float:
    """Energy of columns, bending and what is in series, mJ."""
    shear = springs.table[:, 5] * np.sum(tips.force**2, axis=1)
    column = tips.normal**2 / springs.normal
    return float(0.5 * np.sum(column + springs.table[:, 4] * tips.bent**2 + shear))
