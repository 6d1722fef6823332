"""Ranks of truths among samples: uniform where posteriors are right, and not where they are not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import norm

from sliplab.analysis.twin.calibration_checks import ranks, uniformity
from sliplab.storage.streams import F64, I64

WORLDS, SAMPLES = 200, 99


def found_with(width: float, shift: float, seed: int) -> I64:
    """Ranks where theta is N(0, 1), is seen with noise of 1, and the posterior is distorted."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(WORLDS, 1))
    seen = theta + rng.normal(size=(WORLDS, 1))
    # the posterior is N(seen / 2, 1 / 2)
    spread = width * np.sqrt(0.5)
    samples = seen[:, None] / 2 + shift + spread * rng.normal(size=(WORLDS, SAMPLES, 1))
    return ranks(theta, samples)[:, 0]


def test_a_right_posterior_is_rejected_as_often_as_the_level_says() -> None:
    checks = [uniformity(found_with(1.0, 0.0, seed), SAMPLES) for seed in range(100)]
    # 5 of 100 are expected, more than 11 with a probability of 0.4 %
    assert sum(check.bins_p < 0.05 for check in checks) <= 11
    assert sum(check.band_p < 0.05 for check in checks) <= 11


@pytest.mark.parametrize(("width", "shift"), [(0.6, 0.0), (1.7, 0.0), (1.0, 0.35), (1.0, -0.35)])
def test_wrong_posteriors_are_rejected(width: float, shift: float) -> None:
    check = uniformity(found_with(width, shift, 7), SAMPLES)
    assert check.band_p < 0.01
    assert ((check.below < check.low) | (check.below > check.high)).any()
    assert check.bins_p < 0.05


def test_the_band_holds_uniform_ranks_wholly_in_95_of_100_cases() -> None:
    rng = np.random.default_rng(3)
    kept = 0
    for _ in range(100):
        check = uniformity(rng.integers(0, 41, 60), 40)
        kept += bool(((check.below >= check.low) & (check.below <= check.high)).all())
    assert 88 <= kept <= 100


def test_one_cut_has_the_exact_binomial_probability() -> None:
    found = np.array([0] * 16 + [1] * 4)
    check = uniformity(found, 1)
    # 16 or more of 20 below the middle: 0.59 %, two-sided 1.18 %
    assert check.at.tolist() == [0.5]
    assert check.band_p == pytest.approx(0.0118, abs=0.006)
    assert check.bins.tolist() == [16, 4]
    # chi-square of one degree of freedom: (16 - 10)^2 / 10 twice
    assert check.bins_p == pytest.approx(2 * norm.sf(np.sqrt(7.2)))


def test_ranks_count_the_samples_below() -> None:
    samples: F64 = np.array([[[1.0, 5.0], [2.0, 6.0], [3.0, 7.0]]])
    assert ranks(np.array([[2.5, 1.0]]), samples).tolist() == [[2, 0]]


def test_ranks_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match=r"within 0\.\.5"):
        uniformity(np.array([6]), 5)
    with pytest.raises(ValueError, match=r"within 0\.\.5"):
        uniformity(np.array([], np.int64), 5)
    with pytest.raises(ValueError, match=r"do not fit"):
        ranks(np.zeros((2, 3)), np.zeros((2, 5, 4)))
