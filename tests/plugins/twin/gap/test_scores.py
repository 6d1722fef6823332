"""How far a network is behind another, from counts whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.evaluation.trials import EvaluatedTrials
from sliplab.analysis.metrics import classification
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.plugins.twin.gap.scores import behind, macro_f1
from sliplab.protocols.windows import Windows

Y = np.array([0, 1, 2, 0, 1, 2])


def judged(said: list[int], trials: tuple[str, ...] = ("a", "b")) -> EvaluatedTrials:
    """A network's classes of three windows of each of two trials; 3 is undecided."""
    counts = np.zeros((len(said), 3), np.int64)
    for row, k in enumerate(said):
        if k < 3:
            counts[row, k] = 9
    windows, names = SampleSet.join([], Windows()).windows, tuple(("pilot", it) for it in trials)
    samples = SampleSet(windows, Y, np.repeat([0, 1], 3), np.zeros(6, np.int64), names)
    return EvaluatedTrials(counts, samples, [])


def test_the_difference_is_over_the_same_trials() -> None:
    # in each trial the second network has one window less
    found = behind(judged([0, 1, 2, 0, 1, 3]), judged([0, 1, 3, 0, 3, 3]))
    assert found.share == pytest.approx(2 / 6)
    assert found.low is found.high is None  # equal differences say nothing of other trials
    other = behind(judged([0, 1, 2, 0, 1, 2]), judged([0, 1, 2, 3, 3, 3]))
    assert other.share == pytest.approx(0.5)
    assert other.low is not None
    assert other.low < 0.0
    with pytest.raises(ValueError, match="on other trials"):
        behind(judged([0] * 6), judged([0] * 6, ("a", "c")))


def test_f1_of_a_class_that_is_never_found_is_0() -> None:
    said = judged([0, 1, 1, 0, 1, 1])
    # precision 1, 1/2 and none; recall 1, 1 and 0
    assert macro_f1(classification.score(said.counts, Y)) == pytest.approx((1 + 2 / 3 + 0) / 3)
    right = judged([0, 1, 2, 0, 1, 2])
    assert macro_f1(classification.score(right.counts, Y)) == 1.0
    assert macro_f1(classification.score(right.counts[:2], Y[:2])) is None
