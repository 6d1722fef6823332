"""Detectors that must score badly do, and the numbers add up."""

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.detectors.latency import (
    TrialLatency,
    TrueSlip,
    score_trial,
    summarise_latency,
    summarise_lead,
    true_slip,
)
from sliplab.analysis.detectors.smoothing_rule import Detections, detect
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.label import TrialLabel

MS = 1_000_000
TOLERANCE = 30 * MS
START = 1_800_000_000_000_000_000  # a date: differences must be taken in whole numbers


def said(incipient_ns: int | None, gross_ns: int | None) -> Detections:
    return Detections(incipient_ns, gross_ns, np.zeros((0, 3)), np.zeros(0, np.int8))


def judge(incipient_ms: float | None, gross_ms: float | None) -> TrialLatency:
    """True onsets at 1000 and 1500 ms, rest at 1800; detections in ms after START."""
    found = [None if v is None else START + round(v * MS) for v in (incipient_ms, gross_ms)]
    return score_trial(said(*found), slip(1000, 1500, 1800), TOLERANCE)


def slip(*ms: int) -> TrueSlip:
    return TrueSlip(*(START + each * MS for each in ms))


def test_a_good_detector() -> None:
    trial = judge(1088, 1570)
    assert (trial.latency_incipient_ms, trial.latency_gross_ms, trial.lead_ms) == (88, 70, 412)
    assert trial.late_incipient_ms is trial.late_gross_ms is None
    assert not trial.missed_incipient
    assert not trial.false_early_incipient


def test_a_nanosecond_is_not_lost() -> None:
    trial = score_trial(said(START + 1, None), TrueSlip(START, START + 5, START + 9), 0)
    assert trial.latency_incipient_ms == 1e-6
    assert trial.lead_ms == 4e-6


def test_early_within_the_tolerance_counts_and_beyond_it_does_not() -> None:
    inside = judge(970, 1470)
    assert (inside.latency_incipient_ms, inside.latency_gross_ms) == (-30, -30)
    outside = judge(970 - 1e-6, 1470 - 1e-6)
    assert outside.false_early_incipient
    assert outside.false_early_gross
    assert outside.latency_incipient_ms is outside.latency_gross_ms is outside.lead_ms is None


def test_a_detection_after_its_event_is_late_and_nothing_else() -> None:
    trial = judge(1600, 1900)
    assert (trial.late_incipient_ms, trial.late_gross_ms) == (100, 100)
    assert trial.latency_incipient_ms is trial.latency_gross_ms is trial.lead_ms is None
    assert not trial.missed_gross
    assert not trial.false_early_incipient
    # at the end itself nothing is left of the event; a nanosecond before, something is
    assert judge(1500, 1800).late_incipient_ms == judge(1500, 1800).late_gross_ms == 0
    before = judge(1500 - 1e-6, 1800 - 1e-6)
    assert (before.lead_ms, before.latency_gross_ms) == (1e-6, 300 - 1e-6)


def test_gross_slip_cried_while_the_plate_lies_still_is_not_detected() -> None:
    # the audit's case: 8 plates that rest, and a detector that says gross slip 0.3 to 2 s later
    after = (299, 480, 655, 810, 1100, 1400, 1700, 1959)
    trials = [judge(1400, 1800 + ms) for ms in after]
    found = summarise_latency(trials).gross
    assert (found.n, found.missed, found.late, found.false_early) == (0, 0, 8, 0)
    assert found.mean is None


def run(counts: np.ndarray) -> list[TrialLatency]:
    """The same windows of 30 ms, judged in 20 trials with slip beginning after 0.3 to 0.9 s."""
    end_ns = START + 30 * MS * np.arange(1, len(counts) + 1, dtype=np.int64)
    found = detect(counts, end_ns, Detection(smoothing=4, margin=2))
    onsets = [START + (300 + 30 * k) * MS for k in range(20)]
    return [score_trial(found, TrueSlip(t, t + 500 * MS, t + 900 * MS), TOLERANCE) for t in onsets]


def test_crying_incipient_at_once_earns_nothing() -> None:
    trials = run(np.tile([0, 9, 0], (60, 1)))
    assert all(t.false_early_incipient and t.missed_gross for t in trials)
    lead = summarise_lead(trials)
    assert (lead.n, lead.detected_first, lead.false_early) == (0, 0, 20)
    assert lead.mean is lead.min is lead.std is None
    latency = summarise_latency(trials)
    assert latency.incipient.mean is None
    assert latency.gross.missed == 20


def test_a_silent_detector_misses_everything() -> None:
    trials = run(np.zeros((60, 3), int))
    for summary in (*dict(summarise_latency(trials)).values(), summarise_lead(trials)):
        assert (summary.n, summary.missed, summary.false_early) == (0, 20, 0)


def test_a_perfect_detector() -> None:
    trials = [judge(1000, 1500) for _ in range(5)]
    latency = summarise_latency(trials)
    zeros = dict.fromkeys(("mean", "std", "median", "p95", "min", "max"), 0.0)
    counts = {"n": 5, "missed": 0, "late": 0, "false_early": 0}
    assert latency.incipient.to_json() == latency.gross.to_json() == {**zeros, **counts}
    lead = summarise_lead(trials)
    assert (lead.min, lead.mean, lead.std, lead.detected_first) == (500, 500, 0, 5)


def test_statistics_in_closed_form() -> None:
    trials = [judge(1000 + 10 * k, None) for k in range(21)]  # 0, 10 .. 200
    found = summarise_latency(trials).incipient
    assert (found.mean, found.median, found.min, found.max) == (100, 100, 0, 200)
    assert found.p95 == pytest.approx(190)
    assert found.std == pytest.approx(10 * np.sqrt(21 * 22 / 12))  # divisor n - 1


def test_one_value_has_no_spread() -> None:
    found = summarise_latency([judge(1010, 1510)]).incipient
    assert (found.mean, found.std, found.n) == (10, None, 1)


def test_no_trials() -> None:
    text = json.dumps([each.to_json() for each in (summarise_latency([]), summarise_lead([]))])
    assert json.loads(text)[1]["n"] == 0


moments = st.none() | st.integers(0, 3000)


@given(st.lists(st.tuples(moments, moments), max_size=30))
def test_every_trial_is_counted_once(found: list[tuple[int | None, int | None]]) -> None:
    trials = [judge(a, b) for a, b in found]
    lead = summarise_lead(trials)
    for summary in (*dict(summarise_latency(trials)).values(), lead):
        assert summary.n + summary.missed + summary.late + summary.false_early == len(trials)
        assert (summary.mean is None) == (summary.n == 0)
    assert lead.detected_first == sum((t.lead_ms or 0) > 0 for t in trials)
    assert all(t.lead_ms is None or t.lead_ms > 0 for t in trials)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="before incipient onset"):
        TrueSlip(5, 4, 6)
    with pytest.raises(ValueError, match="end 5 ns is before gross onset 6 ns"):
        TrueSlip(4, 6, 5)
    with pytest.raises(ValueError, match="false_early_ns = -1"):
        score_trial(said(None, None), TrueSlip(4, 5, 6), -1)


def test_a_label_tells_of_a_slip() -> None:
    label = TrialLabel(incipient_ns=4, gross_ns=6, end_ns=9)
    assert true_slip(label) == TrueSlip(4, 6, 9)
    assert true_slip(label.model_copy(update={"gross_ns": None})) is None
    # a person set the onset after the plate's rest
    assert true_slip(label.model_copy(update={"gross_ns": 11})) == TrueSlip(4, 11, 11)
