"""Times that run back: the longest consistent part stays, whatever is around it."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.storage.formats import time_order
from sliplab.storage.formats.time_order import falls, in_order

ROWS = np.arange(2000, dtype=np.int64) * 10
LATE = 10**12
TIES = ROWS // 30


def twice(rows: np.ndarray, first: int, times: int = 1) -> np.ndarray:
    """Rows of which those from `first` to 900 come again."""
    return np.concatenate([rows[:900], *[rows[first:900]] * times, rows[900:]])


def without(first: int, end: int, count: int) -> list[int]:
    """Rows that stay: all but some."""
    return [*range(first), *range(end, count)]


CASES = {
    "rows of the run before, at the start": (np.r_[ROWS[:20] + LATE, ROWS], slice(20, None)),
    "rows of the run before, within the times": (np.r_[ROWS[:20] + 777, ROWS], slice(20, None)),
    "one late row": (np.r_[ROWS[:500], LATE, ROWS[500:]], without(500, 501, 2001)),
    "one early row": (np.r_[ROWS[:500], 0, ROWS[500:]], without(500, 501, 2001)),
    "a late row at the start": (np.r_[LATE, ROWS], slice(1, None)),
    "an early row at the end": (np.r_[ROWS, 5], slice(0, -1)),
    "other times": (np.r_[ROWS[:900], ROWS[:100] + LATE, ROWS[900:]], without(900, 1000, 2100)),
    "earlier": (np.r_[ROWS[:900] + LATE, ROWS[:100], ROWS[900:] + LATE], without(900, 1000, 2100)),
    "a restart in the first half": (np.r_[ROWS[:900], ROWS], slice(900, None)),
    "a restart in the second half": (np.r_[ROWS, ROWS[:900]], slice(0, 2000)),
    "a packet twice": (twice(ROWS, 700), without(900, 1100, 2200)),
    "a packet three times": (twice(ROWS, 700, 2), without(900, 1300, 2400)),
    "again later": (np.r_[ROWS[:900], ROWS[300:500], ROWS[900:]], without(900, 1100, 2200)),
    "a packet of equal times twice": (twice(TIES, 701), without(900, 1099, 2199)),
    "two restarts": (np.r_[ROWS[:500], ROWS, ROWS[:900]], slice(500, 2500)),
}


@pytest.mark.parametrize("case", CASES)
def test_longest_consistent_part_stays(case: str) -> None:
    times, wanted = CASES[case]
    expected = np.zeros(len(times), bool)
    expected[wanted] = True
    np.testing.assert_array_equal(in_order(times), expected)


@pytest.mark.parametrize("times", [[], [5], [5, 5, 6], list(ROWS)])
def test_ordered_times_stay_whole(times: list[int]) -> None:
    found = np.array(times, np.int64)
    assert not falls(found)
    assert in_order(found).all()


def test_random_times_stay_ordered_and_as_many_as_possible() -> None:
    rng = np.random.default_rng(2)
    for _ in range(200):
        times = rng.integers(0, 12, rng.integers(1, 13))
        kept = time_order._longest(times)
        assert not falls(times[kept])
        lengths = [1] * len(times)  # of the longest sequence that ends at each row
        for row in range(len(times)):
            before = [lengths[k] for k in range(row) if times[k] <= times[row]]
            lengths[row] = 1 + max(before, default=0)
        assert kept.sum() == max(lengths)


def test_many_rows_keep_their_longest_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time_order, "MOST_ROWS", 100)
    times = np.r_[ROWS[:50], ROWS, ROWS[:70]]
    np.testing.assert_array_equal(np.flatnonzero(in_order(times)), np.arange(50, 2050))
