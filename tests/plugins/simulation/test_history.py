"""Rows at uneven times: found, joined by straight lines, forgotten when nobody needs them."""

import numpy as np
import pytest

from sliplab.plugins.simulation.history import GrowingTable


def filled(times: list[int]) -> GrowingTable:
    history = GrowingTable(2)
    history.grow(np.array(times, np.int64))[:] = np.array(times)[:, None] * [1.0, -2.0]
    return history


def test_rows_between_reach_over_both_ends() -> None:
    history = filled([0, 4, 8, 9, 10, 16])
    for (first, last), expected in {
        (0, 0): [0],
        (1, 3): [0, 4],
        (4, 8): [4, 8],
        (5, 9): [4, 8, 9],
        (9, 99): [9, 10, 16],
        (16, 20): [16],
    }.items():
        times, rows = history.between(first, last)
        assert times.tolist() == expected
        assert rows[:, 0].tolist() == expected
    with pytest.raises(IndexError, match="before the stored history"):
        history.between(-1, 3)
    with pytest.raises(IndexError):
        GrowingTable(2).between(0, 1)


def test_between_rows_the_line_is_straight_and_after_the_end_it_stays() -> None:
    history = filled([0, 4, 8, 9, 10, 16])
    asked = np.array([0, 1, 4, 7, 9, 13, 16, 30], np.int64)
    expected = np.minimum(asked, 16)[:, None] * [1.0, -2.0]
    assert history.at(asked) == pytest.approx(expected)
    assert history.at(np.empty(0, np.int64)).shape == (0, 2)
    assert filled([5]).at(np.array([5, 9], np.int64))[:, 0].tolist() == [5, 5]


def test_growing_and_forgetting_keep_what_is_asked_for() -> None:
    history = filled([0])
    for k in range(1, 9000):
        history.grow(np.array([k], np.int64))[:] = k
        history.forget(k - 100)
    assert history.end_ns == 8999
    assert 0 < history.begin_ns <= 8899
    assert history.at(np.array([8899], np.int64))[0, 0] == 8899
    history.shrink(10, 8989)
    assert history.end_ns == 8989
