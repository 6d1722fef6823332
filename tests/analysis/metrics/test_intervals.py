"""Intervals over trials: against SciPy's, and by how often they hold what is true."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from sliplab.analysis.metrics.intervals import (
    STATISTICS,
    between_seeds,
    count_difference,
    difference,
    drawn,
    exact_interval,
    interval,
    mean_interval,
    median_interval,
    rate_interval,
    share_difference,
    share_interval,
)

RNG = np.random.default_rng(7)
LATE = RNG.gamma(4.0, 25.0, 180)
"""As latencies are: positive and skewed."""
SIZES = (3, 6, 12, 132)
SOME = [pytest.param(n, marks=() if n in {3, 12} else pytest.mark.long) for n in SIZES]
"""Few, where approximations fail first, and a usual number; the long tests have all."""
NOISE = 2.6 / np.sqrt(1500) * np.sqrt(0.05 * 0.95)
"""By which a share of 95 % in 1,500 draws is off in one case of a hundred."""


def coverage(
    measure: Callable[[np.random.Generator], Any], truth: float, seed: int, tried: int = 1500
) -> float:
    """In which share of sets of trials the interval holds the truth."""
    rng = np.random.default_rng(seed)
    spans = [measure(rng) for _ in range(tried)]
    return float(np.mean([low <= truth <= high for low, high in spans]))


def as_said(found: float) -> bool:
    """Return whether a measured coverage is compatible with 93 to 97 %."""
    return 0.93 - NOISE <= found <= 0.97 + NOISE


@pytest.mark.quick(1)
@pytest.mark.parametrize("n", SOME)
@pytest.mark.parametrize("kind", ["normal", "skewed"])
def test_a_mean_is_held_as_often_as_said(kind: str, n: int) -> None:
    def measure(rng: np.random.Generator) -> Any:
        return interval(rng.normal(80, 20, n) if kind == "normal" else rng.gamma(4, 20, n))

    assert as_said(coverage(measure, 80.0, n))


@pytest.mark.quick(1)
@pytest.mark.parametrize("n", SOME)
@pytest.mark.parametrize(("a", "b"), [(18, 2), (9, 1)])
def test_a_share_of_windows_is_held_as_often_as_said(a: int, b: int, n: int) -> None:
    """Trials of 100 to 200 windows, each with a share of its own."""

    def measure(rng: np.random.Generator) -> Any:
        windows = rng.integers(100, 200, n)
        return share_interval(rng.binomial(windows, rng.beta(a, b, n)), windows)

    assert as_said(coverage(measure, a / (a + b), n))


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("statistic", "n"), [("median", 6), ("median", 12), ("median", 132), ("p95", 72), ("p95", 132)]
)
def test_a_quantile_is_held_as_often_as_said(statistic: str, n: int) -> None:
    truth = stats.gamma.ppf({"median": 0.5, "p95": 0.95}[statistic], 4, scale=25)
    found = coverage(lambda rng: interval(rng.gamma(4, 25, n), statistic), truth, n)
    assert as_said(found)


@pytest.mark.quick(1)
@pytest.mark.parametrize("n", SOME)
@pytest.mark.parametrize("paired", [False, True])
def test_a_difference_of_means_is_held_as_often_as_said(paired: bool, n: int) -> None:
    """Every sixth trial or so has no value in one of the two sets."""

    def measure(rng: np.random.Generator) -> Any:
        shared = rng.normal(80, 20, n) * paired
        a, b = (shared + rng.normal(0, 20, n) for _ in range(2))
        if n > 3:
            a[rng.random(n) < 1 / 6] = np.nan
        found = difference(a + 10, b, paired=paired)
        return (-np.inf, np.inf) if found is None else found

    assert as_said(coverage(measure, 10.0, n))


@pytest.mark.parametrize("n", SOME)
def test_a_difference_of_shares_is_held_as_often_as_said(n: int) -> None:
    def measure(rng: np.random.Generator) -> Any:
        windows = rng.integers(100, 200, n)
        each = rng.beta(18, 2, n)
        a, b = rng.binomial(windows, each), rng.binomial(windows, 0.9 * each)
        return share_difference((a, windows), (b, windows))

    assert as_said(coverage(measure, 0.09, n))


@pytest.mark.quick(1)
@pytest.mark.parametrize("paired", [False, True])
@pytest.mark.parametrize("n", SOME)
@pytest.mark.parametrize(("p", "q"), [(0.02, 0.0), (1.0, 0.95), (0.1, 0.1), (0.3, 0.4)])
def test_difference_of_counts_of_trials_is_held(p: float, q: float, n: int, paired: bool) -> None:
    """Of the same trials half are alike for what they share."""

    def measure(rng: np.random.Generator) -> Any:
        a, b = rng.random((2, n))
        b = np.where(paired & (rng.random(n) < 0.5), a, b)
        return count_difference(a < p, b < q, paired=paired)

    assert coverage(measure, p - q, n) >= 0.92


def test_difference_of_counts_is_newcombes() -> None:
    """Newcombe 1998, table II (a) and (b): 56 of 70 less 48 of 80, 9 of 10 less 3 of 10."""
    for (x, n), (y, m), known in (
        ((56, 70), (48, 80), (0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.1705, 0.8090)),
    ):
        first, second = np.arange(n) < x, np.arange(m) < y
        assert count_difference(first, second) == pytest.approx(known, abs=1e-4)
    # pairs that agree as often as by chance are two sets; those that agree more bound it more
    a, b, c = np.repeat([[1, 1, 1], [1, 0, 1], [0, 1, 0], [0, 0, 0]], 10, axis=0).T
    assert count_difference(a, b, paired=True) == count_difference(a, b)
    paired, free = (np.ptp(count_difference(a, c, paired=it)) for it in (True, False))
    assert 0 < paired < free / 2
    with pytest.raises(ValueError, match="0 or 1"):
        count_difference([0.5], [1.0])


@pytest.mark.quick(1)
@pytest.mark.parametrize("paired", [False, True])
def test_a_difference_of_medians_is_held_at_least_as_often_as_said(paired: bool) -> None:
    def measure(rng: np.random.Generator) -> Any:
        shared = rng.gamma(3, 25, 12) * paired
        return difference(
            shared + rng.gamma(2, 25, 12), shared + rng.gamma(2, 25, 12), "median", paired=paired
        )

    assert coverage(measure, 0.0, 5, 250) >= 0.92


def test_a_mean_of_few_is_students() -> None:
    # six trials of which the audit said: 85.5 to 97.2, not 87.3 to 95.3
    for n in SIZES:
        values = RNG.gamma(4.0, 25.0, n)
        known = stats.t.interval(0.95, n - 1, values.mean(), stats.sem(values))
        assert interval(values) == pytest.approx(known)
        weighed = mean_interval(values * 50, np.full(n, 50.0))
        assert weighed == pytest.approx(known)


def test_a_median_of_few_lies_between_the_ranks_of_scipy() -> None:
    for n in (6, 12, 132):
        values = np.sort(RNG.gamma(4.0, 25.0, n))
        exact = stats.quantile_test(values, p=0.5).confidence_interval(0.95)
        found = interval(values, "median")
        # no wider than whole ranks, and at most one rank narrower on either side
        a, b = (int(np.flatnonzero(values == edge)[0]) for edge in (exact.low, exact.high))
        assert values[a] <= found[0] <= values[a + 1]
        assert values[b - 1] <= found[1] <= values[b]


def test_counts_have_the_exact_interval() -> None:
    for count, n in ((0, 8), (1, 130), (65, 130), (130, 130), (2, 3)):
        known = stats.binomtest(count, n).proportion_ci(method="exact")
        assert exact_interval(count, n) == pytest.approx((known.low, known.high), abs=1e-12)
    assert exact_interval(0, 0) == (0.0, 1.0)


def test_a_share_that_all_trials_have_alike_is_known_by_their_number() -> None:
    windows = np.full(6, 150)
    assert share_interval(windows, windows) == exact_interval(6, 6)
    assert share_interval(0 * windows, windows) == exact_interval(0, 6)
    assert share_interval(windows / 2, windows) is None


def test_log_odds_of_many_trials_are_students() -> None:
    windows = np.full(400, 150.0)
    hits = RNG.binomial(150, RNG.beta(18, 2, 400))
    found, plain = share_interval(hits, windows), mean_interval(hits, windows)
    assert found == pytest.approx(plain, abs=0.03 * (plain[1] - plain[0]))


def test_two_sets_differ_as_welch_says() -> None:
    for n, m in ((200, 150), (3, 5)):
        a, b = RNG.normal(90.0, 20.0, n), RNG.normal(80.0, 30.0, m)
        welch = stats.ttest_ind(a, b, equal_var=False).confidence_interval()
        assert difference(a, b) == pytest.approx((welch.low, welch.high))


@pytest.mark.parametrize(
    "found",
    [
        difference(LATE + 30.0, LATE, paired=True),
        difference([10.0, 10.0], [20.0, 20.0]),
        share_difference(([50.0, 50.0], [50.0, 50.0]), ([0.0, 0.0], [50.0, 50.0])),
        between_seeds([0.1, 0.1, 0.1], [0.3, 0.3]),
    ],
)
def test_equal_trials_bound_no_difference(found: object) -> None:
    assert found is None


def test_intervals_of_several_differences_hold_at_once() -> None:
    """Of six differences without an effect none excludes zero in 95 % of sets."""
    rng = np.random.default_rng(3)
    sets = rng.normal(0, 20, (1000, 6, 2, 4))
    for comparisons, low, high in ((1, 0.65, 0.85), (6, 0.93, 0.97)):
        spans = [[difference(*x, comparisons=comparisons) for x in six] for six in sets]
        at_once = np.mean([all(a <= 0 <= b for a, b in six) for six in spans])
        assert low < at_once < high


def test_pairs_know_what_they_have_in_common() -> None:
    other = LATE + RNG.normal(3.0, 5.0, len(LATE))
    known = stats.ttest_rel(other, LATE).confidence_interval()
    assert difference(other, LATE, paired=True) == pytest.approx((known.low, known.high))
    loose = difference(other, LATE)
    assert loose[0] < 0 < known.low
    with pytest.raises(ValueError, match="no pairs"):
        difference([1.0, 2.0], [1.0, 2.0, 3.0], paired=True)


def test_trials_without_a_value_are_left_out_of_a_difference() -> None:
    gaps = LATE.copy()
    gaps[::3] = np.nan
    found = difference(gaps, LATE, "median", paired=True)
    assert found[0] < np.nanmedian(gaps) - np.median(LATE) < found[1]
    assert difference([np.nan, np.nan, 1.0], [1.0, 2.0, 3.0], paired=True) is None


def test_too_few_trials_have_no_interval() -> None:
    for values in ([], [3.0], [3.0, 3.0, 3.0]):
        assert interval(values) is None
    for few, statistic in ((5, "median"), (71, "p95")):
        assert interval(LATE[:few], statistic) is None
    for few, statistic in ((11, "median"), (71, "p95")):
        assert difference(LATE[:few], LATE, statistic) is None
    assert share_difference(([1.0], [2.0]), ([1.0], [2.0])) is None
    assert share_interval([1.0], [2.0]) is share_interval([], []) is None
    for bad in ([1.0, np.inf], [1.0, np.nan]):
        with pytest.raises(ValueError, match="finite"):
            interval(bad)


@settings(max_examples=20)
@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=90), st.sampled_from(["median", "p95"]))
def test_a_quantile_s_interval_lies_within_the_values(values: list[float], statistic: str) -> None:
    found = interval(values, statistic)
    if found is None:
        assert statistic == "p95"
        assert len(values) < 72
        return
    middle = STATISTICS[statistic](np.array(values), axis=0)
    slack = 1e-9 * max(1.0, *map(abs, values))
    assert min(values) - slack <= found[0] <= middle + slack
    assert middle - slack <= found[1] <= max(values) + slack


def test_draws_are_the_same_at_every_call() -> None:
    assert (drawn(9) == drawn(9)).all()
    a, b = RNG.normal(9.0, 2.0, 20), RNG.normal(8.0, 3.0, 30)
    assert difference(a, b, "median") == difference(a, b, "median")


def test_shares_must_be_of_the_same_trials() -> None:
    windows = RNG.integers(20, 150, 40).astype(float)
    with pytest.raises(ValueError, match="same trials"):
        share_difference((windows, windows), (windows[1:], windows[1:]))


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


@pytest.mark.parametrize("count", [0, 1, 7, 300])
def test_rate_of_clusters_that_are_alike_is_garwoods(count: int) -> None:
    counts = np.full(30, count / 30)
    low, high = rate_interval(counts, np.full(30, 0.1)) or (np.nan, np.nan)
    assert 3 * high == pytest.approx(stats.chi2.ppf(0.975, 2 * count + 2) / 2)
    assert 3 * low == pytest.approx(stats.chi2.ppf(0.025, 2 * count) / 2 if count else 0.0)


def test_rate_of_one_cluster_has_no_interval() -> None:
    assert rate_interval([12], [1.0]) is None


def test_rate_is_wider_where_few_clusters_have_all_events() -> None:
    hours = np.full(20, 0.1)
    alike = rate_interval(np.full(20, 3.0), hours)
    few = rate_interval(np.array([30.0, 30.0, *np.zeros(18)]), hours)
    assert few[1] - few[0] > 3 * (alike[1] - alike[0])


def test_differences_between_strata_are_no_chance() -> None:
    """Two conditions of the design have all events, in every repetition."""
    counts, hours = np.array([30.0] * 4 + [0.0] * 16), np.full(20, 0.1)
    within = rate_interval(counts, hours, np.repeat(np.arange(5), 4).tolist())
    poisson = stats.chi2.ppf(0.975, 2 * 120 + 2) / 2 / 2
    assert within[1] == pytest.approx(poisson)
    # strata of a single cluster say nothing of chance: they are compared with each other
    assert rate_interval(counts, hours, np.arange(20).tolist()) == rate_interval(counts, hours)


def test_median_of_single_values_is_that_by_ranks() -> None:
    expected = interval(LATE, "median")
    assert median_interval(LATE, range(len(LATE))) == expected
    missed = np.r_[LATE[:7], np.inf]
    low, high = median_interval(missed, range(8)) or (np.nan, np.nan)
    assert low < np.median(missed) < high == np.inf


def test_median_of_worlds_knows_that_their_values_are_alike() -> None:
    worlds = np.repeat(np.arange(8), 50)
    values = 100.0 + 10.0 * worlds + np.tile(np.linspace(-1, 1, 50), 8)
    low, high = median_interval(values, worlds.tolist()) or (np.nan, np.nan)
    assert (low, high) == pytest.approx((109.0, 161.0), abs=2.0)
    by_ranks = interval(values, "median")
    assert high - low > 2 * (by_ranks[1] - by_ranks[0])
    assert median_interval(values[:250], worlds[:250].tolist()) is None, "five worlds"


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from([10.0, 20.0, 30.0, 40.0, np.inf]), st.integers(0, 7)),
        min_size=1,
        max_size=60,
    )
)
def test_interval_of_a_median_of_ties_holds_it(rows: list[tuple[float, int]]) -> None:
    values = np.array([value for value, _ in rows])
    span = median_interval(values, [world for _, world in rows])
    middle = np.sort(values)[(len(values) - 1) // 2]
    if span is not None:
        assert span[0] <= middle <= span[1]


def test_difference_of_medians_counts_infinite_values() -> None:
    lost = np.r_[LATE[:150], np.full(30, np.inf)]
    found = difference(lost, LATE, "median", paired=True)
    assert found[0] > 0, "as many slow ones as were lost"
    assert difference(np.r_[LATE[:80], np.full(100, np.inf)], LATE, "median") is None
    # where a draw loses both medians, their difference may be anything
    few = np.r_[LATE[:7], np.full(5, np.inf)]
    assert difference(few + 10.0, few, "median", paired=True) is None
    with pytest.raises(ValueError, match="infinite"):
        difference(lost, LATE)


@pytest.mark.parametrize("statistic", ["mean", "median"])
def test_interval_stops_at_the_least_that_can_be(statistic: str) -> None:
    values = [1.0, 2.0, 2.5, 3.0, 4.0, 90.0]
    free = interval([value - 30 for value in values], statistic)
    assert free[0] < 0
    bounded = interval([value - 30 for value in values], statistic, least=0.0)
    assert bounded == (0.0, max(free[1], 0.0))
    lost = interval([600.0, 610.0, 650.0, 700.0, 720.0, 800.0, -np.inf, -np.inf], "median", 0.0)
    assert lost[0] == -np.inf, "an open end is no measured one"


def test_cluster_of_a_stratum_alone_has_the_variance_of_its_count() -> None:
    """Five alike in one condition, and one in another: Poisson's interval, no narrower."""
    found = rate_interval([4.0] * 5 + [40.0], [0.1] * 6, ["a"] * 5 + ["b"])
    assert found[1] == pytest.approx(stats.chi2.ppf(0.975, 122) / 2 / 0.6)
    assert found[0] == pytest.approx(stats.chi2.ppf(0.025, 120) / 2 / 0.6)
