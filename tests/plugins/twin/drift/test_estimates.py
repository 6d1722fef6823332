"""Lines through fits of reference trials: against closed forms, and how often intervals hold."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.plugins.twin.drift.estimates import drifts, line_through
from sliplab.plugins.twin.posterior import Bank
from sliplab.storage.streams import F64


def simulated(
    rng: np.random.Generator, k: int, slope: float, scatter: float
) -> tuple[F64, F64, F64]:
    """Places, values and variances of references; scatter goes beyond the variances."""
    places = np.sort(rng.choice(200, k, replace=False)).astype(np.float64)
    variances = rng.uniform(0.5, 2.0, k) ** 2 * 1e-4
    noise = rng.normal(size=k) * np.sqrt(variances) + scatter * rng.normal(size=k)
    return places, 0.3 + slope * places + noise, variances


@pytest.mark.quick(1)
@pytest.mark.parametrize("k", [4, 10])
@pytest.mark.parametrize("scatter", [0.0, 0.03])
def test_intervals_hold_and_false_alarms_are_as_many_as_said(k: int, scatter: float) -> None:
    rng = np.random.default_rng(k)
    lines = [line_through(*simulated(rng, k, -0.002, scatter)) for _ in range(600)]
    held = np.mean([line.low <= -0.002 <= line.high for line in lines])
    # one standard error is 0.9 %; without scatter the variances are a bound and intervals wide
    assert held > 0.92
    assert np.mean([line.slope for line in lines]) == pytest.approx(-0.002, abs=5e-5)
    steady = [line_through(*simulated(rng, k, 0.0, scatter)).p for _ in range(600)]
    assert np.mean(np.array(steady) < 0.05) < 0.08


def test_a_line_without_scatter_is_the_weighted_one() -> None:
    places, spread = np.array([3.0, 10.0, 40.0, 90.0]), np.array([0.1, 0.2, 0.1, 0.3])
    values = np.array([1.01, 0.97, 0.85, 0.55])
    line = line_through(places, values, spread**2)
    slope, start = np.polyfit(places - 3.0, values, 1, w=1.0 / spread)
    assert line.slope == pytest.approx(slope)
    assert line.start == pytest.approx(start)
    assert line.scatter == 0.0
    x = places - 3.0
    mean = np.average(x, weights=spread**-2)
    error = 1.0 / np.sqrt(np.sum((x - mean) ** 2 / spread**2))
    assert line.high - line.low == pytest.approx(2 * 4.302652730 * error)  # t, 2 degrees of freedom


def test_a_line_takes_three_values() -> None:
    two = np.array([0.0, 1.0])
    with pytest.raises(ValueError, match="at least 3"):
        line_through(two, two, np.ones(2))
    with pytest.raises(ValueError, match="more than one place"):
        line_through(np.zeros(3), np.arange(3.0), np.ones(3))


@pytest.mark.long
def test_a_slope_is_not_taken_towards_the_prior() -> None:
    """Though half of the prior's interval is left of each fit."""
    rng = np.random.default_rng(3)
    theta = rng.uniform(-1.0, 1.0, (400, 2))
    noise = 0.3
    s = theta[:, :1] + noise * rng.normal(size=(400, 1))
    bank = Bank(("seen", "unseen"), ("s",), theta, s, np.full(2, -1.0), np.full(2, 1.0))
    places = np.linspace(1.0, 101.0, 40)
    slopes = []
    for _ in range(20):
        truth = 0.4 - 0.008 * (places - 1.0)
        observed = (truth + noise * rng.normal(size=40))[:, None]
        found = drifts(bank, observed, places)
        slopes.append(found[0].line.slope)
        assert not found[1].identified
    assert np.mean(slopes) == pytest.approx(-0.008, rel=0.06)


def test_a_statistic_that_one_reference_lacks_is_left_out_there() -> None:
    rng = np.random.default_rng(4)
    theta = rng.uniform(-1.0, 1.0, (200, 1))
    s = np.column_stack([theta, theta]) + 0.05 * rng.normal(size=(200, 2))
    bank = Bank(("seen",), ("a", "b"), theta, s, np.full(1, -1.0), np.full(1, 1.0))
    observed = np.array([[0.5, 0.5], [np.nan, 0.4], [0.3, np.nan], [0.2, 0.2]])
    (found,) = drifts(bank, observed, np.arange(4.0))
    assert found.identified
    assert found.values == pytest.approx([0.5, 0.4, 0.3, 0.2], abs=0.04)
    assert found.line.low < -0.1 < found.line.high
