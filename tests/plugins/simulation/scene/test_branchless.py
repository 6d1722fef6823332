"""Exponential and logarithm against high precision."""

import mpmath
import numpy as np
import pytest

from sliplab.plugins.simulation.scene.branchless import exp_minus, logarithm

EPS = float(np.finfo(np.float64).eps)


@pytest.mark.parametrize(("low", "high"), [(1e-12, 1e-3), (1e-3, 1.0), (1.0, 50.0), (50.0, 690.0)])
def test_decayed_is_the_exponential(low: float, high: float) -> None:
    for way in np.geomspace(low, high, 300):
        assert exp_minus(way) == pytest.approx(float(mpmath.exp(-mpmath.mpf(way))), rel=3 * EPS)


@pytest.mark.parametrize(
    ("low", "high"), [(1e-300, 1e-3), (0.3, 3.0), (0.999, 1.001), (3.0, 1e300)]
)
def test_logarithm_is_the_logarithm(low: float, high: float) -> None:
    for x in np.geomspace(low, high, 300):
        assert logarithm(x) == pytest.approx(float(mpmath.log(mpmath.mpf(x))), rel=3 * EPS, abs=0)


def test_their_ends() -> None:
    assert exp_minus(0.0) == 1.0
    assert 0.0 < exp_minus(np.inf) < 1e-300
    assert logarithm(1.0) == 0.0
