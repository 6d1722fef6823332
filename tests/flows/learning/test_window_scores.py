"""Whose a sample is, where campaigns number their trials alike."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from analysis.nets.dataset import SampleSet
from analysis.nets.sparse import SparseWindows
from flows.learning.window_scores import whose


def samples(numbers: list[int]) -> SampleSet:
    n = len(numbers)
    x = SparseWindows.of(np.zeros((n, 1, 1, 2, 2), np.uint8))
    return SampleSet(x, np.zeros(n, np.int64), np.array(numbers, np.int64), np.arange(n))


def trials(numbers: list[int]) -> list[Any]:
    return [(None, SimpleNamespace(index=number), None) for number in numbers]


def test_samples_belong_to_the_next_trial_of_their_number() -> None:
    known = trials([0, 3, 5, 0, 5])  # two campaigns; the trial 3 gave no samples
    assert whose(known, samples([0, 0, 5, 0, 0, 5])).tolist() == [0, 0, 2, 3, 3, 4]
    assert whose(known, samples([])).tolist() == []


def test_samples_of_no_trial_are_refused() -> None:
    with pytest.raises(ValueError, match="number 4"):
        whose(trials([0, 3]), samples([0, 4]))
