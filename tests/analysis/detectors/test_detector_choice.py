"""Levels, intervals and choices, worked out by hand and against the definition."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors import detector_comparison
from sliplab.analysis.detectors.detector_comparison import (
    TrialEvidence,
    allowed_early,
    merit,
    set_levels,
)
from sliplab.analysis.detectors.detectors import Levels, WindowEvidence
from sliplab.analysis.detectors.latency import TrialLatency, TrueSlip
from sliplab.analysis.detectors.rule_sweep import SpikeCounts, choose_smoothing, settled
from sliplab.protocols.detection import Detection

MS = 1_000_000
EARLY = 30 * MS


def judged(
    incipient: list[float], gross: list[float], onset: int = 4, second: int = 7
) -> TrialEvidence:
    n = len(incipient)
    ends = 30 * MS * np.arange(1, n + 1, dtype=np.int64)
    return TrialEvidence(
        WindowEvidence(ends, np.array(incipient, float), lambda first: np.array(gross, float)),
        TrueSlip(onset * 30 * MS, second * 30 * MS, (n + 1) * 30 * MS),
    )


VALUES = st.lists(st.integers(-5, 5).map(float), min_size=9, max_size=9)


@settings(max_examples=40)
@given(st.lists(st.tuples(VALUES, VALUES), min_size=1, max_size=8), st.data())
def test_levels_let_through_what_is_allowed_and_are_the_lowest(
    rows: list[tuple[list[float], list[float]]], data: st.DataObject
) -> None:
    trials = [judged(*row) for row in rows]
    allowed = data.draw(st.integers(0, len(trials) - 1))
    levels = set_levels(trials, allowed, EARLY)

    def early(incipient: float, gross: float) -> tuple[int, int]:
        scored = detector_comparison.outcomes(trials, Levels(incipient, gross), EARLY)
        return (
            sum(t.false_early_incipient for t in scored),
            sum(t.false_early_gross for t in scored),
        )

    assert max(early(levels.incipient, levels.gross)) <= allowed
    below = np.nextafter(levels.incipient, -np.inf)
    assert levels.incipient == -np.inf or early(below, levels.gross)[0] > allowed
    below = np.nextafter(levels.gross, -np.inf)
    assert levels.gross == -np.inf or early(levels.incipient, below)[1] > allowed


def test_a_level_by_hand() -> None:
    # windows end at 30, 60, .. ms, the onset is at 120: those that end before 90 are too early
    trials = [
        judged([1, 5, 9, 9, 9, 9, 9, 9, 9], [0] * 9),
        judged([2, 3, 9, 9, 9, 9, 9, 9, 9], [0] * 9),
    ]
    assert set_levels(trials, 0, EARLY).incipient == 5
    assert set_levels(trials, 1, EARLY).incipient == 3


def test_no_bound_is_refused() -> None:
    with pytest.raises(ValueError, match="no bound"):
        set_levels([], 0, EARLY)
    with pytest.raises(ValueError, match="no bound"):
        set_levels([judged([0.0] * 9, [0.0] * 9)], 1, EARLY)


@pytest.mark.parametrize(
    ("rate", "trials", "allowed"),
    [(0.005, 130, 0), (0.01, 130, 1), (0.02, 130, 2), (0.29, 100, 29), (0.1, 0, 0), (0, 50, 0)],
)
def test_a_share_is_a_whole_number_of_trials(rate: float, trials: int, allowed: int) -> None:
    assert allowed_early(rate, trials) == allowed


def scored(latency: float | None, early: bool = False) -> TrialLatency:
    none = dict.fromkeys(("latency_gross_ms", "lead_ms", "late_incipient_ms", "late_gross_ms"))
    return TrialLatency(
        latency_incipient_ms=latency,
        missed_incipient=latency is None and not early,
        missed_gross=True,
        false_early_incipient=early,
        false_early_gross=False,
        **none,
    )


def test_a_missed_onset_is_late_and_a_false_one_is_left_out() -> None:
    assert merit([scored(10), scored(30), scored(None)]) == (30, np.inf)
    assert merit([scored(10), scored(30), scored(None, early=True)]) == (20, 30)
    assert merit([scored(None), scored(None), scored(5)]) == (np.inf, np.inf)
    assert merit([]) == (np.inf, np.inf)


def counted(
    rows: list[tuple[int, int, int]], onset: int, gross: int = 99, end: int = 100
) -> SpikeCounts:
    ends = 30 * MS * np.arange(1, len(rows) + 1, dtype=np.int64)
    slip = TrueSlip(onset * 30 * MS, gross * 30 * MS, end * 30 * MS)
    return SpikeCounts(np.array(rows), ends, slip)


def test_the_quickest_pair_within_the_bound_is_chosen() -> None:
    # one stray window long before the onset: one window alone is fooled at a small margin
    stray, quiet, slip = (0, 4, 0), (5, 0, 0), (0, 9, 0)
    trials = [counted([quiet, stray, *[quiet] * 8, *[slip] * 6], 10)] * 2
    ask = Detection(smoothing_grid=(1, 4), margin_grid=(1.0, 5.0), false_early_rate=0.0)
    choice = choose_smoothing(trials, ask, "validation")
    assert (choice.smoothing, choice.margin, choice.false_early) == (1, 5.0, 0)
    assert (choice.split, choice.trials, choice.allowed, choice.median_ms) == (
        "validation",
        2,
        0,
        30.0,
    )
    after = settled(ask, choice)
    assert (after.smoothing, after.margin, after.smoothing_grid) == (1, 5.0, (1, 4))
    assert settled(ask, None) is ask


def test_the_bound_holds_for_gross_slip_too() -> None:
    # one window of gross slip long before it truly begins: it fools a single window only
    quiet, slip, stray, gross = (9, 0, 0), (0, 9, 0), (0, 0, 9), (0, 0, 9)
    rows = [*[quiet] * 8, *[slip] * 8, stray, *[slip] * 8, *[gross] * 6]
    trial = counted(rows, 8, 25)
    ask = Detection(smoothing_grid=(1, 4), margin_grid=(2.0,), false_early_rate=0.0)
    choice = choose_smoothing([trial], ask, "validation")
    assert (choice.smoothing, choice.false_early, choice.false_early_gross) == (4, 0, 0)


def test_a_margin_that_some_trials_never_reach_is_not_chosen() -> None:
    # two trials slip strongly; the third weakly, less than a stray window's lead
    quiet, stray, gross = (9, 0, 0), (0, 4, 0), (0, 0, 9)

    def trial(slip: tuple[int, int, int]) -> SpikeCounts:
        rows = [*[quiet] * 3, stray, *[quiet] * 4, *[slip] * 8, *[gross] * 8]
        return counted(rows, 8, 16)

    trials = [trial((0, 9, 0)), trial((0, 9, 0)), trial((0, 3, 0))]
    ask = Detection(smoothing_grid=(1, 4), margin_grid=(1.0, 5.0), false_early_rate=0.0)
    choice = choose_smoothing(trials, ask, "validation")
    assert (choice.smoothing, choice.margin) == (4, 1.0)
    assert (choice.missed, choice.missed_gross, choice.false_early) == (0, 0, 0)
    quick = choose_smoothing(trials[:2], ask, "validation")
    assert (quick.smoothing, quick.margin) == (1, 5.0)


def test_gross_slip_that_is_seen_after_its_end_keeps_no_bound() -> None:
    # the plate slides for four windows and then lies still; its signal outlasts it in the average
    quiet, slip, gross = (9, 0, 0), (0, 9, 0), (0, 0, 9)
    rows = [*[quiet] * 4, *[slip] * 8, *[gross] * 12]
    ask = Detection(smoothing_grid=(1, 6), margin_grid=(6.0,), false_early_rate=0.0)
    slow = ask.model_copy(update={"smoothing_grid": (6,)})
    late = choose_smoothing([counted(rows, 4, 12, 16)], slow, "validation")
    assert (late.late, late.late_gross, late.missed_gross) == (0, 1, 0)
    found = choose_smoothing([counted(rows, 4, 12, 16)], ask, "validation")
    assert (found.smoothing, found.late_gross) == (1, 0)


def test_where_nothing_keeps_the_bound_the_fewest_are_taken_and_said() -> None:
    trials = [counted([(0, 9, 0)] * 20, 15)] * 3
    ask = Detection(smoothing_grid=(1, 4), margin_grid=(1.0,), false_early_rate=0.1)
    choice = choose_smoothing(trials, ask, "test")
    assert (choice.false_early, choice.allowed, choice.median_ms) == (3, 0, None)


def test_nothing_to_choose_by() -> None:
    with pytest.raises(ValueError, match="no validation trials"):
        choose_smoothing([], Detection(), "validation")
