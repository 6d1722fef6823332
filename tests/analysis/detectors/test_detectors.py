"""Requirements on every detector: causality, and robustness to very short trials."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors import detectors
from sliplab.analysis.detectors.detectors import (
    Levels,
    Predictions,
    Smoothing,
    TrialWithSlip,
    decide,
)
from sliplab.analysis.detectors.latency import TrueSlip
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.protocols.detection import Detection
from tests.patching import loose

MS = 1_000_000
LENGTH = 30 * MS


def predictions(counts: np.ndarray, stride_ms: int = 30) -> Predictions:
    n = len(counts)
    ends = LENGTH + stride_ms * MS * np.arange(n, dtype=np.int64)
    return Predictions(
        np.asarray(counts, np.int64).reshape(n, 3), np.asarray(counts).sum(axis=1), ends
    )


def trial(seed: int, quiet: int = 30, slipping: int = 20, sliding: int = 20) -> TrialWithSlip:
    rng = np.random.default_rng(seed)
    means = np.repeat([(9, 3, 3), (3, 9, 4), (2, 4, 9)], [quiet, slipping, sliding], axis=0)
    counts = np.minimum(rng.poisson(means), 30)
    first, second = quiet * LENGTH, (quiet + slipping) * LENGTH
    return TrialWithSlip(predictions(counts), TrueSlip(first, second, second + sliding * LENGTH))


LEARNED = detectors.learn([trial(seed) for seed in range(8)], LENGTH, 30)
FINE = LEARNED.detectors(1 / 3)
DETECTORS: dict[str, detectors.DetectionRule] = {
    "smoothing": Smoothing(4),
    **LEARNED.detectors(1.0),
    "fine": FINE["hmm counts"],
}
ROWS = st.lists(st.tuples(*[st.integers(0, 30)] * 3), max_size=25)


@pytest.mark.parametrize("name", DETECTORS)
@settings(max_examples=10, deadline=None)
@given(rows=ROWS, later=ROWS, data=st.data())
def test_later_windows_change_nothing(
    name: str, rows: list[tuple[int, ...]], later: list[tuple[int, ...]], data: st.DataObject
) -> None:
    detector = DETECTORS[name]
    table = np.array([*rows, *later]).reshape(-1, 3)
    whole = detector.evidence(predictions(table))
    part = detector.evidence(predictions(table[: len(rows)]))
    assert (whole.incipient[: len(rows)] == part.incipient).all()
    if rows:
        first = data.draw(st.integers(0, len(rows) - 1))
        after = slice(first + 1, len(rows))
        assert (whole.gross_after(first)[after] == part.gross_after(first)[after]).all()


@pytest.mark.parametrize("name", DETECTORS)
@settings(max_examples=10, deadline=None)
@given(rows=ROWS, first=st.integers(0, 24))
def test_window_by_window_is_the_whole_to_the_bit(
    name: str, rows: list[tuple[int, ...]], first: int
) -> None:
    seen = predictions(np.array(rows).reshape(-1, 3))
    rule = DETECTORS[name]
    whole, state = rule.evidence(seen), rule.begin()
    for k in range(len(rows)):
        state, one = rule.push(state, seen[k : k + 1])
        assert one.incipient[0] == whole.incipient[k]
        if k > first:
            assert one.gross_after(-1)[0] == whole.gross_after(first)[k]
        if k == first:
            state = rule.detected(state)


@pytest.mark.parametrize("name", DETECTORS)
def test_no_windows_silent_windows_and_a_trial_without_slip(name: str) -> None:
    detector = DETECTORS[name]
    for counts in (np.empty((0, 3)), np.zeros((1, 3))):
        evidence = detector.evidence(predictions(counts))
        assert len(evidence.incipient) == len(counts)
        assert not np.isnan(evidence.incipient).any()
    silent = detector.evidence(predictions(np.zeros((200, 3))))
    assert not np.isnan(silent.incipient).any()
    calm, slips = trial(99, 300, 0, 0), trial(100)
    level = float(detector.evidence(calm.predictions).incipient.max())
    found = decide(detector.evidence(calm.predictions), Levels(level, 3.0))
    assert (found.incipient_ns, found.gross_ns) == (None, None)
    found = decide(detector.evidence(slips.predictions), Levels(level, 3.0))
    assert found.gross_ns is not None
    assert slips.slip.incipient_ns < found.incipient_ns < slips.slip.gross_ns < found.gross_ns


@pytest.mark.parametrize("stride_ms", [30, 10])
def test_the_papers_rule_is_the_same_rule(stride_ms: int) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        one = predictions(rng.integers(0, 12, (40, 3)), stride_ms)
        margin = float(rng.integers(1, 9)) / 4
        expected = detect(one.counts, one.end_ns, Detection(smoothing=4, margin=margin))
        # evidence exceeds a level where the lead is at least the margin: leads are quarters
        level = margin - 1 / 8
        found = decide(Smoothing(4).evidence(one), Levels(level, level))
        assert found.incipient_ns == expected.incipient_ns
        assert found.gross_ns == expected.gross_ns


def test_states_go_by_the_middle_of_a_window() -> None:
    slip = TrueSlip(2 * LENGTH + 15 * MS, 4 * LENGTH + 16 * MS, 6 * LENGTH)
    one = TrialWithSlip(predictions(np.zeros((6, 3))), slip)
    assert one.states(LENGTH).tolist() == [0, 0, 1, 1, 1, 2]


def test_a_finer_stride_leaves_states_as_often_a_second() -> None:
    fine = loose(FINE["hmm counts"]).chain
    np.testing.assert_allclose((1 - fine.leave) ** 3, 1 - LEARNED.chain.leave)


def test_gross_needs_incipient_first() -> None:
    evidence = Smoothing(1).evidence(predictions(np.array([(0, 0, 9), (0, 9, 0), (0, 0, 9)])))
    found = decide(evidence, Levels(1.0, 1.0))
    assert (found.incipient_ns, found.gross_ns) == (2 * LENGTH, 3 * LENGTH)
    assert decide(evidence, Levels(99.0, 1.0)).gross_ns is None


def test_a_level_must_be_exceeded() -> None:
    assert detectors.first_above(np.array([1.0, 2.0, 3.0]), 2.0) == 2
    assert detectors.first_above(np.array([3.0, 2.0, 3.0]), 2.0, 1) == 2
    assert detectors.first_above(np.empty(0), 0.0) is None


def test_no_trials_teach_nothing_and_break_nothing() -> None:
    for detector in detectors.learn([], LENGTH, 30).detectors(1.0).values():
        evidence = detector.evidence(predictions(np.full((5, 3), 4)))
        assert np.isfinite(evidence.incipient).all()


@pytest.mark.parametrize(
    "make",
    [
        lambda: Predictions(np.zeros((2, 3), np.int64), np.zeros(3, np.int64), np.arange(2)),
        lambda: Predictions(np.zeros((2, 2), np.int64), np.zeros(2, np.int64), np.arange(2)),
        lambda: Predictions(
            np.zeros((2, 3), np.int64), np.zeros(2, np.int64), np.zeros(2, np.int64)
        ),
    ],
)
def test_wrong_input_is_named(make: Callable[[], Predictions]) -> None:
    with pytest.raises(ValueError, match=r"windows|do not increase"):
        make()
