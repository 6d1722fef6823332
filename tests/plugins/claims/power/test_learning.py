"""Learning curves with a known law."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.windows.dataset import SampleSet, TrialId
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.plugins.claims.power.learning import fit_curve, learning_of, share_of

TRIALS = np.array([25.0, 50.0, 75.0, 100.0])


def test_a_law_is_found_again() -> None:
    curve = fit_curve(TRIALS, 0.05 + 0.8 * TRIALS**-0.5)
    assert (curve.floor, curve.scale, curve.exponent) == pytest.approx((0.05, 0.8, 0.5), abs=1e-6)


def test_an_error_that_rises_has_no_gain_to_expect() -> None:
    """By chance more trials gave a worse classifier: scale 0, not a falling accuracy."""
    curve = fit_curve(TRIALS, np.array([0.10, 0.11, 0.12, 0.13]))
    assert curve.scale == pytest.approx(0.0)
    assert curve.error(np.array([1e6]))[0] == pytest.approx(0.115)


@pytest.mark.long
def test_what_more_trials_give_is_in_the_interval() -> None:
    inside = 0
    for world in range(8):
        rng = np.random.default_rng(world)
        error = 0.05 + 0.8 * TRIALS**-0.5
        hits = rng.random((3, 4, 60)) < 1.0 - error[:, None]
        found = learning_of("a law", TRIALS, hits.astype(np.float64), 600)
        assert found.low <= found.expected <= found.high
        assert found.floor >= 0.0
        inside += found.low <= 1.0 - 0.05 - 0.8 * 600**-0.5 <= found.high
    assert inside >= 7


def test_shares_are_nested_and_of_whole_trials() -> None:
    y = np.arange(40) % 3
    trial = np.repeat(np.arange(8), 5)
    windows = SparseWindows.of(np.ones((40, 2, 1, 2, 2), np.uint8))
    names = tuple(TrialId("c", f"t{k}") for k in range(8))
    samples = SampleSet(windows, y, trial, np.zeros(40, np.int64), names)
    for order in range(3):
        parts = [share_of(samples, share, order) for share in (0.25, 0.5, 1.0)]
        assert [count for count, _ in parts] == [2, 4, 8]
        assert [len(part) for _, part in parts] == [10, 20, 40]
        there = [set(part.trial.tolist()) for _, part in parts]
        assert there[0] < there[1] < there[2]
