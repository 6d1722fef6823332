"""Bent papillae are shorter and softer (L2), relax and have two frictions (L3)."""

import math

import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sliplab.plugins.simulation.scene.skin import SkinGeometry, make_skin
from sliplab.plugins.simulation.scene.springs import SLIDING, STUCK, make_springs, new_tips
from tests.plugins.simulation.scene.steps import (
    MU,
    at,
    ideal_skin,
    line,
    places,
    pressed,
    run,
    slid,
    springs_of,
)

GEOMETRY = SkinGeometry()


def slip_stretch(i: int, depth: float, mu: float = MU) -> tuple[float, float]:
    """Deflection and normal force at which a papilla of the ideal skin lets go, by mpmath."""
    skin = ideal_skin()
    h, kn = float(skin.height_mm[i]), float(skin.normal_n_per_mm[i])
    kb, cr = float(skin.bending_n_per_mm[i]), float(skin.compliance_mm_per_n[i])
    delta = depth - float(skin.gap_mm[i])
    mpmath.mp.dps = 30

    def normal(b):
        return kn * (delta - mpmath.mpf("0.6") * b**2 / h)

    def shear(b):
        return b * (kb - mpmath.mpf("1.2") * normal(b) / h)

    bend = mpmath.findroot(lambda b: shear(b) - mu * normal(b), mu * kn * delta / kb)
    return float(bend + cr * shear(bend)), float(normal(bend))


@pytest.mark.parametrize("steps", [5, 1000])
@pytest.mark.parametrize("depth", [2.4, 3.4])
def test_a_bent_papilla_lets_go_where_its_potential_says(depth: float, steps: int) -> None:
    springs = springs_of(ideal_skin(), level=2)
    tips = pressed(springs, depth)
    track, _ = run(springs, tips, line((0, 0, depth), (15, 0, depth), steps))
    for i in (0, 1, 18):
        stretch, normal = slip_stretch(i, depth)
        assert slid(track)[-1, i] == pytest.approx(15 - stretch, abs=1e-9)
        assert tips.normal[i] == pytest.approx(normal, rel=1e-10)
        assert tips.force[i, 0] == pytest.approx(MU * normal, rel=1e-10)


def test_a_small_deflection_is_as_stiff_as_the_linear_spring_less_its_load() -> None:
    skin = ideal_skin()
    for depth in (0.2, 2.0):
        tips, springs = pressed(springs_of(skin, level=2), depth), springs_of(skin, level=2)
        run(springs, tips, line((0, 0, depth), (1e-5, 0, depth), 1))
        buckles_at = 10 * skin.bending_n_per_mm[0] * skin.height_mm[0] / 12
        bending = skin.bending_n_per_mm[0] * (1 - tips.normal[0] / buckles_at)
        expected = 1 / (1 / bending + skin.compliance_mm_per_n[0])
        assert tips.force[0, 0] / 1e-5 == pytest.approx(expected, rel=1e-6)


def test_the_buckling_load_is_that_of_a_guided_column() -> None:
    skin = ideal_skin()
    clamped = 10 * skin.bending_n_per_mm[0] * skin.height_mm[0] / 12
    euler = math.pi**2 * 0.6 * (math.pi * 2.0**4 / 4) / 10.1**2
    assert clamped == pytest.approx(euler, rel=0.02)
    assert euler == pytest.approx(0.73, abs=0.005)


@pytest.mark.parametrize("depth", [2.4, 3.4, 6.0, 20.0])
def test_a_rigid_base_brings_the_centre_to_buckling_and_stays_finite(depth: float) -> None:
    skin = make_skin(SkinGeometry(base_normal_n_per_m=None), 1)
    springs = springs_of(skin, level=3, relaxation_share=0.2, strengthening=0.01)
    tips = pressed(springs, depth)
    assert tips.normal[0] > 0.73  # N, beyond the buckling load
    track, load = run(springs, tips, line((0, 0, depth), (6, 2, depth), 400))
    assert np.all(np.isfinite(places(track)))
    assert np.all(np.isfinite(load))
    assert np.all(load[..., 2] >= 0)
    # the clamp leaves a stiffness, so a stuck tip still pulls back
    stuck = tips.mode == STUCK
    assert np.all(np.sum(tips.force * (tips.base - tips.place), axis=1)[stuck] > 0)


@pytest.mark.parametrize("level", [2, 3])
def test_forces_are_continuous_along_a_smooth_way(level: int) -> None:
    # halving the step halves the largest change of any force: there is no jump in between
    springs = springs_of(ideal_skin(), level, relaxation_share=0.2, strengthening=0.01)
    largest = []
    for steps in (4000, 8000):
        tips = pressed(springs)
        _, load = run(springs, tips, line((0, 0, 2.8), (9, 5, 2.2), steps), h=16 / steps)
        largest.append(np.abs(np.diff(load, axis=0)).max())
    assert largest[0] / largest[1] == pytest.approx(2.0, rel=0.1)


def test_relaxing_tips_follow_an_independent_integration() -> None:
    """Press, wait and drag a tip along x: stuck, then sliding, against scipy at 1e-12."""
    skin = ideal_skin()
    share, tau, mu = 0.2, 1.0, MU
    springs = springs_of(skin, level=3, relaxation_share=share, relaxation_s=tau)
    springs = make_springs_linear(springs)
    kn, kt, m = skin.normal_n_per_mm[0], skin.tangential_n_per_mm[0], share / (1 - share)
    tips = new_tips(19)
    run(springs, tips, line((0, 0, 0), (0, 0, 2.8), 10), h=0.14)
    run(springs, tips, at(0, 0, 2.8), h=0.5)
    branch = m * kn * tau * 2.0 * (1 - math.exp(-1.4 / tau)) * math.exp(-0.5 / tau)
    assert tips.normal[0] == pytest.approx(kn * 2.8 + branch, rel=1e-12)
    # stuck: f = k v t + m k v tau (1 - e^(-t/tau)) until mu N(t)
    v = 1.0

    def force(t: float) -> float:
        return kt * v * t + m * kt * v * tau * (1 - math.exp(-t / tau))

    def limit(t: float) -> float:
        return mu * (kn * 2.8 + branch * math.exp(-t / tau))

    mpmath.mp.dps = 25
    onset = float(mpmath.findroot(lambda t: force(float(t)) - limit(float(t)), 6.0, tol=1e-20))
    coarse = []
    for steps in (300, 3000):
        copy = tips.copy()
        run(springs, copy, line((0, 0, 2.8), (15, 0, 2.8), steps), h=15 / v / steps)
        coarse.append(copy.slipped_s[0])
    # inside a step the exponential is taken as a line: second order
    assert coarse[0] == pytest.approx(onset, abs=2e-4)
    assert coarse[1] == pytest.approx(onset, abs=2e-6)

    def sliding(t: float, y: np.ndarray) -> list[float]:
        # f = k e + q on the cone: k e' + q' = limit'(t), q' = -q / tau + m k e'
        slope = -mu * branch * math.exp(-t / tau) / tau
        stretch = (slope + y[1] / tau) / (kt * (1 + m))
        return [stretch, -y[1] / tau + m * kt * stretch]

    start = [v * onset, m * kt * v * tau * (1 - math.exp(-onset / tau))]
    solution = solve_ivp(sliding, (onset, 15.0), start, rtol=1e-12, atol=1e-14)
    assert copy.mode[0] == SLIDING
    assert 15 - copy.path[0] == pytest.approx(solution.y[0, -1], abs=1e-5)


def make_springs_linear(springs):
    """The same law without large deflection."""
    table = springs.table.copy()
    table[:, 7] = 0.0
    return type(springs)(table, springs.friction, springs.law)


@pytest.mark.parametrize("speed", [0.6, 1.6])
def test_friction_rises_with_speed_as_told(speed: float) -> None:
    springs = springs_of(ideal_skin(), 3, strengthening=0.02, static_excess=0.03)
    tips = pressed(springs)
    run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 1000), h=15e-3 / speed)
    grip = np.hypot(tips.force[:, 0], tips.force[:, 1]) / tips.normal
    assert grip == pytest.approx(np.full(19, MU * (1 + 0.02 * math.log1p(speed / 0.1))), rel=1e-4)


def test_levels_leave_out_what_they_do_not_have() -> None:
    skin = ideal_skin()
    options = {"relaxation_share": 0.2, "static_excess": 0.03, "strengthening": 0.02}
    knots = np.full((19, 1), MU)
    first, second, third = (make_springs(skin, knots, level, **options) for level in (1, 2, 3))
    assert np.all(first.table[:, 7] == 0)
    assert np.all(second.table[:, 7] == 0.6 / skin.height_mm)
    assert first.law.maxwell == second.law.maxwell == second.law.static_excess == 0.0
    assert third.law.maxwell == 0.25
    with pytest.raises(ValueError, match="must be one of"):
        make_springs(skin, knots, 4)
