"""Friction along a tip's path: its statistics, its smoothness and its slope."""

import math

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.friction import (
    KNOT_MM,
    KNOTS,
    friction_field,
    friction_knots,
    grip_at,
)
from tests.plugins.simulation.scene.steps import MU, ideal_skin


def test_it_varies_by_as_much_and_as_fast_as_it_is_told() -> None:
    skin = ideal_skin()
    knots = friction_knots(skin, MU, 0.05, 0.5, seed=3)
    assert np.array_equal(knots, friction_knots(skin, MU, 0.05, 0.5, seed=3))
    assert not np.array_equal(knots, friction_knots(skin, MU, 0.05, 0.5, seed=4))
    relative = knots / MU - 1
    # some 19 x 120 independent pieces: the deviation is known to 2 % of itself
    assert relative.std() == pytest.approx(0.05, rel=0.06)
    correlation = (relative * np.roll(relative, 5, axis=1)).mean() / relative.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.06)


def test_the_field_goes_through_its_knots_and_has_the_slope_that_it_says() -> None:
    knots = friction_knots(ideal_skin(), MU, 0.1, 0.3, seed=5)
    field = friction_field(knots)
    for i, k in ((0, 0), (3, 17), (18, KNOTS - 1)):
        assert grip_at(field, i, (k + 1e-13) * KNOT_MM)[0] == pytest.approx(knots[i, k], abs=1e-10)
    period = KNOTS * KNOT_MM
    for path in np.random.default_rng(1).uniform(0, 2 * period, 50):
        grip, slope = grip_at(field, 4, path)
        near = [grip_at(field, 4, path + d)[0] for d in (-1e-6, 1e-6)]
        assert slope == pytest.approx((near[1] - near[0]) / 2e-6, abs=1e-6)
        assert grip == pytest.approx(grip_at(field, 4, path + period)[0], abs=1e-9)


def test_the_slope_is_continuous_at_the_knots() -> None:
    field = friction_field(friction_knots(ideal_skin(), MU, 0.1, 0.3, seed=5))
    for k in range(1, 40):
        before, after = (grip_at(field, 2, k * KNOT_MM + d)[1] for d in (-1e-9, 1e-9))
        assert before == pytest.approx(after, abs=1e-6)


def test_without_variation_it_is_flat_and_stays_above_a_fifth() -> None:
    flat = friction_field(friction_knots(ideal_skin(), MU, 0.0, 0.5, 1))
    assert grip_at(flat, 3, 12.34) == (pytest.approx(MU), 0.0)
    rough = friction_knots(ideal_skin(), MU, 0.3, 0.5, 1)
    assert rough.min() >= 0.2 * MU * (1 - 1e-12)
