"""Intervals over trials, held against SciPy's and against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from analysis.statistics.intervals import (
    STATISTICS,
    between_seeds,
    difference,
    drawn,
    interval,
    share_difference,
)

RNG = np.random.default_rng(7)
LATE = RNG.gamma(4.0, 25.0, 180)
"""As latencies are: positive and skewed."""


@pytest.mark.parametrize("statistic", ["mean", "median", "p95"])
def test_an_interval_is_scipys(statistic: str) -> None:
    ours = interval(LATE, statistic)
    assert ours is not None
    theirs = stats.bootstrap(
        (LATE,), STATISTICS[statistic], n_resamples=4000, method="percentile", rng=3
    ).confidence_interval
    width = theirs.high - theirs.low
    assert ours[0] == pytest.approx(theirs.low, abs=0.12 * width)
    assert ours[1] == pytest.approx(theirs.high, abs=0.12 * width)


def test_the_interval_of_a_mean_is_students() -> None:
    values = RNG.normal(80.0, 20.0, 400)
    found = interval(values)
    assert found is not None
    half = 1.96 * values.std(ddof=1) / np.sqrt(len(values))
    assert found[0] == pytest.approx(values.mean() - half, abs=0.1 * half)
    assert found[1] == pytest.approx(values.mean() + half, abs=0.1 * half)


def test_two_sets_differ_as_welch_says() -> None:
    a, b = RNG.normal(90.0, 20.0, 200), RNG.normal(80.0, 30.0, 150)
    found = difference(a, b)
    welch = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
    assert found is not None
    half = (welch.high - welch.low) / 2
    assert found == (
        pytest.approx(welch.low, abs=0.12 * half), pytest.approx(welch.high, abs=0.12 * half)
    )  # fmt: skip


def test_pairs_know_what_they_have_in_common() -> None:
    assert difference(LATE + 30.0, LATE, paired=True) == (pytest.approx(30.0), pytest.approx(30.0))
    loose, tight = difference(LATE + 3.0, LATE), difference(LATE + 3.0, LATE, paired=True)
    assert loose is not None
    assert tight is not None
    assert loose[0] < 0 < tight[0]
    with pytest.raises(ValueError, match="no pairs"):
        difference([1.0, 2.0], [1.0, 2.0, 3.0], paired=True)


def test_trials_without_a_value_are_left_out_of_a_difference() -> None:
    gaps = LATE.copy()
    gaps[::3] = np.nan
    found = difference(gaps, LATE, "median", paired=True)
    assert found is not None
    assert found[0] < np.nanmedian(gaps) - np.median(LATE) < found[1]
    assert difference([np.nan, np.nan, 1.0], [1.0, 2.0, 3.0], paired=True) is None


def test_too_few_trials_have_no_interval() -> None:
    assert interval([]) is None
    assert interval([3.0]) is None
    assert share_difference(([1.0], [2.0]), ([1.0], [2.0])) is None
    for bad in ([1.0, np.inf], [1.0, np.nan]):
        with pytest.raises(ValueError, match="finite"):
            interval(bad)


@settings(max_examples=20)
@given(st.lists(st.floats(-1e6, 1e6), min_size=2, max_size=30), st.sampled_from(sorted(STATISTICS)))
def test_an_interval_lies_within_the_values(values: list[float], statistic: str) -> None:
    found = interval(values, statistic)
    assert found is not None
    slack = 1e-9 * max(1.0, *map(abs, values))
    assert min(values) - slack <= found[0] <= found[1] <= max(values) + slack
    assert found == interval(values, statistic)  # the same draws at every call


def test_shares_of_windows_draw_whole_trials() -> None:
    windows = RNG.integers(20, 150, 40).astype(float)
    a, b = np.floor(0.9 * windows), np.floor(0.85 * windows)
    found = share_difference((a, windows), (b, windows))
    k = drawn(len(windows))
    by_hand = [(a[row].sum() - b[row].sum()) / windows[row].sum() for row in k]
    assert found == (
        pytest.approx(np.quantile(by_hand, 0.025)), pytest.approx(np.quantile(by_hand, 0.975))
    )  # fmt: skip
    with pytest.raises(ValueError, match="same trials"):
        share_difference((a, windows), (b[1:], windows[1:]))


def test_seeds_differ_as_student_says() -> None:
    a, b = [0.90, 0.92, 0.91], [0.93, 0.95, 0.94, 0.92]
    known = stats.ttest_ind(a, b).confidence_interval()
    noise = between_seeds(a, b)
    assert noise == pytest.approx((known.high - known.low) / 2)
    # one seed borrows the other set's spread: a prediction interval
    one = between_seeds(a, [0.93])
    spread = float(np.std(a, ddof=1))
    assert one == pytest.approx(stats.t.ppf(0.975, 2) * spread * np.sqrt(1 + 1 / 3))
    assert between_seeds([0.9], [0.8]) is None
    assert between_seeds([], a) is None
