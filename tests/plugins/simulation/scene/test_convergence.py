"""Convergence of the contact law with its step, against an independent scheme."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from benchmarks.one_slide import run_slide
from sliplab.plugins.simulation.scene.friction import friction_field, friction_knots, grip_at
from sliplab.plugins.simulation.scene.springs import make_springs
from tests.plugins.simulation.scene.steps import MU, ideal_skin

RICH = {"static_excess": 0.03, "relaxation_share": 0.2, "strengthening": 0.01}


@pytest.mark.parametrize("level", [1, 2])
def test_a_straight_slide_over_rough_friction_is_exact_at_any_step(level: int) -> None:
    springs = make_springs(ideal_skin(), friction_knots(ideal_skin(), MU, 0.05, 0.5, 3), level)
    fine = run_slide(springs, 2.8, 1.0, 0.0, step_mm=0.0125)
    for factor in (2, 8):
        coarse = run_slide(springs, 2.8, 1.0, 0.0, step_mm=0.0125 * factor)
        assert coarse.loads[1:] == pytest.approx(fine.loads[factor::factor], abs=1e-12)


def test_the_force_over_rough_friction_is_the_first_balance_on_the_way() -> None:
    # spring against friction along the path, solved for each place by bracketing alone
    skin = ideal_skin()
    knots = friction_knots(skin, MU, 0.05, 0.5, 3)
    run = run_slide(make_springs(skin, knots, 1), 2.8, 1.0, 0.0, step_mm=0.05)
    field, k, normal = friction_field(knots), skin.tangential_n_per_mm[0], run.loads[0, 2]
    for row in (150, 201, 255, 300):
        way = 0.05 * row

        def balance(slid: float, way: float = way) -> float:
            return k * (way - slid) - grip_at(field, 0, slid)[0] * normal

        stuck = float(way - MU * 1.3 * normal / k)
        slid = brentq(balance, max(stuck, 0.0), way - MU * 0.7 * normal / k, xtol=1e-14)
        assert run.loads[row, 0] == pytest.approx(k * (way - slid), abs=1e-10)


@pytest.mark.parametrize("step_mm", [0.02, 0.004])
@pytest.mark.parametrize("tip", [0, 1])
def test_a_tip_that_jumps_over_very_rough_friction_is_caught_where_it_first_can_be(
    tip: int, step_mm: float
) -> None:
    # friction varies by 30 % over 0.2 mm: the first place on a dense grid at which friction holds
    skin = ideal_skin()
    knots = friction_knots(skin, MU, 0.3, 0.2, 3)
    run = run_slide(make_springs(skin, knots, 1), 2.8, 1.0, 0.0, length_mm=11.0, step_mm=step_mm)
    k, normal = skin.tangential_n_per_mm[tip], run.loads[0, 3 * tip + 2]
    way = np.arange(0.0, 11.0, 2e-4)
    field = friction_field(knots)
    grip = np.array([grip_at(field, tip, place)[0] for place in way])
    for at_mm in np.arange(4.0, 11.001, 0.1):
        slid = way[np.argmax(grip * normal >= k * (at_mm - way))]
        row = round(at_mm / step_mm)
        assert run.loads[row, 3 * tip] / k == pytest.approx(at_mm - slid, abs=4e-4)


def test_the_whole_law_is_of_second_order_in_its_step() -> None:
    springs = make_springs(ideal_skin(), friction_knots(ideal_skin(), MU, 0.05, 0.5, 3), 3, **RICH)
    fine = run_slide(springs, 2.8, 1.0, 30.0, step_mm=0.0005)
    errors = []
    for step_mm in (0.02, 0.01, 0.005):
        coarse = run_slide(springs, 2.8, 1.0, 30.0, step_mm=step_mm)
        stride = round(step_mm / 0.0005)
        errors.append(np.median(np.abs(coarse.loads[1:] - fine.loads[stride::stride])))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert np.all(orders > 1.5)
    assert errors[-1] < 1e-7  # N


def test_slip_is_located_far_inside_a_step() -> None:
    springs = make_springs(ideal_skin(), friction_knots(ideal_skin(), MU, 0.05, 0.5, 3), 3, **RICH)
    fine = run_slide(springs, 2.8, 1.0, 30.0, step_mm=0.002)
    coarse = run_slide(springs, 2.8, 1.0, 30.0, step_mm=0.2)
    # steps of 200 ms, slips to well under a millisecond
    assert coarse.slipped_s == pytest.approx(fine.slipped_s, abs=1e-3)
    assert math.isfinite(float(np.max(coarse.slipped_s)))
