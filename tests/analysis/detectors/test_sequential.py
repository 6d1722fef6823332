"""CUSUM against its recursion and its closed form."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.detectors.detectors import cusum


@given(st.lists(st.integers(-50, 50), max_size=60))
def test_it_is_the_sum_less_its_lowest_so_far(steps: list[int]) -> None:
    found = cusum(np.array(steps, np.float64))
    sums = np.concatenate([[0], np.cumsum(steps)])
    assert found.tolist() == (sums - np.minimum.accumulate(sums))[1:].tolist()


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=60), st.data())
def test_it_is_causal_and_never_negative(steps: list[float], data: st.DataObject) -> None:
    cut = data.draw(st.integers(0, len(steps)))
    whole, part = cusum(np.array(steps)), cusum(np.array(steps[:cut]))
    assert (whole[:cut] == part).all()
    assert (whole >= 0).all()
    level = 0.0
    for value, step in zip(whole, steps, strict=True):
        level = max(0.0, level + step)
        assert value == level


def test_no_windows() -> None:
    assert cusum(np.empty(0)).shape == (0,)


def test_wrong_input_is_named() -> None:
    for wrong in (np.zeros((2, 2)), np.array([np.inf])):
        with pytest.raises(ValueError, match="log ratios"):
            cusum(wrong)
