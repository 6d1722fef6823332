"""How fast the whole law converges with its step, against a scheme that shares nothing with it."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from rigs.scene.friction import friction_field, friction_knots, grip_at
from rigs.scene.slides import run_slide
from rigs.scene.springs import make_springs
from tests.rigs.scene.steps import MU, ideal_skin

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
