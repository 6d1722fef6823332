"""One decision by several onsets: a false alarm by the one is a latency by the other."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.detectors import onset_references
from sliplab.analysis.detectors.latency import (
    DetectedOnsets,
    TrueSlip,
    score_trial,
    summarise_latency,
    true_slip,
)
from sliplab.analysis.detectors.onset_references import Decided, judge_by_reference, references_of
from sliplab.storage.schema.evaluation import DetectorRate
from sliplab.storage.schema.label import OnsetDoubts, TrialLabel
from sliplab.storage.trials.recording import Recording
from tests.analysis.labels.reviewable import Reviewable
from tests.patching import loose

MS = 1_000_000
START = 1_800_000_000_000_000_000
TOLERANCE = 30 * MS


def reference(
    incipient_ms: int, gross_ms: int = 1500, ends_ms: tuple[int, int] | None = None
) -> onset_references.OnsetReference:
    """Rest at 1800 ms; times in ms after START."""
    slip = TrueSlip(START + incipient_ms * MS, START + gross_ms * MS, START + 1800 * MS)
    return onset_references.OnsetReference(
        slip, None if ends_ms is None else (START + ends_ms[0] * MS, START + ends_ms[1] * MS)
    )


def decided(
    incipient_ms: int | None, references: onset_references.References, gross_ms: int = 1550
) -> Decided:
    found = None if incipient_ms is None else START + incipient_ms * MS
    return Decided(
        DetectedOnsets(found, None if found is None else START + gross_ms * MS),
        references,
        TOLERANCE,
    )


LATE_LABEL: onset_references.References = {
    "paper": reference(1000),
    "change_point": reference(902, 1400, (899, 905)),
    "true": reference(900, 1400),
}


def test_a_decision_between_the_onsets_is_false_early_by_one_and_a_latency_by_the_other() -> None:
    found = judge_by_reference([decided(950, LATE_LABEL)])
    paper, point, true = (found[name].latency_ms.incipient for name in found)
    assert list(found) == ["paper", "change_point", "true"]
    assert (paper.false_early, paper.n, paper.median) == (1, 0, None)
    assert (point.false_early, point.median) == (0, 48)
    assert (true.false_early, true.median) == (0, 50)
    assert [found[name].false_early_rate.value for name in found] == [1, 0, 0]  # type: ignore[union-attr]
    early = [(found[n].early_by_paper, found[n].not_before) for n in found]
    assert early == [(1, 0), (1, 1), (1, 1)]
    # gross slip, too: 1550 ms is 50 after the paper's onset, 150 after the others
    assert [found[name].latency_ms.gross.median for name in found] == [50, 150, 150]


def test_a_real_false_alarm_is_one_by_every_onset() -> None:
    found = judge_by_reference([decided(500, LATE_LABEL)])
    assert [each.latency_ms.incipient.false_early for each in found.values()] == [1, 1, 1]
    assert [(each.early_by_paper, each.not_before) for each in found.values()] == [(1, 0)] * 3


def test_within_the_tolerance_before_the_true_onset_is_a_latency_and_not_after_it() -> None:
    true = judge_by_reference([decided(880, LATE_LABEL)])["true"]
    assert (true.latency_ms.incipient.median, true.not_before) == (-20, 0)


def test_missed_and_late_are_so_by_each_onset_of_its_own() -> None:
    found = judge_by_reference([decided(None, LATE_LABEL), decided(1450, LATE_LABEL, 1900)])
    assert [each.latency_ms.incipient.missed for each in found.values()] == [1, 1, 1]
    # gross slip began at 1400 ms by the true onset: 1450 is a latency by the paper's alone
    assert [each.latency_ms.incipient.late for each in found.values()] == [0, 1, 1]
    assert [each.latency_ms.gross.late for each in found.values()] == [1, 1, 1]


def test_equal_onsets_give_equal_rows() -> None:
    same: onset_references.References = dict.fromkeys(
        ("paper", "change_point", "true"), reference(1000)
    )  # type: ignore[assignment]
    times = (500, 980, 1010, 1020, 1100, 1200, 1300, 1600, None)
    found = judge_by_reference([decided(at, same) for at in times])
    assert found["paper"] == found["change_point"] == found["true"]
    ours = found["paper"]
    figures = ours.latency_ms.incipient
    assert (figures.n, figures.false_early, figures.late, figures.missed) == (6, 1, 1, 1)
    # of -20, 10, 20, 100, 200, 300 and two infinite ones, late and missed
    assert figures.median == 150.0
    assert ours.median_incipient_ms is not None
    low, high = ours.median_incipient_ms
    assert -20 <= low < 10
    assert high is None, "no upper bound"


def test_a_row_is_what_the_trials_judge_gives() -> None:
    decisions = [decided(at, LATE_LABEL) for at in (850, 950, 1010, 1200)]
    for name, figures in judge_by_reference(decisions).items():
        slip = loose(LATE_LABEL[name]).slip
        scored = [score_trial(each.found, slip, TOLERANCE) for each in decisions]
        assert figures.latency_ms == summarise_latency(scored)


def test_a_trial_without_a_change_point_is_counted_as_lacking() -> None:
    without: onset_references.References = {"paper": reference(1000), "true": reference(900, 1400)}
    found = judge_by_reference([decided(950, LATE_LABEL), decided(950, without)])
    assert [(each.trials, each.lacking) for each in found.values()] == [(2, 0), (1, 1), (2, 0)]
    alone = judge_by_reference([decided(950, without)])["change_point"]
    assert (alone.trials, alone.lacking, alone.false_early_rate) == (0, 1, None)
    assert alone.latency_ms.incipient.median is alone.median_incipient_ms is alone.width_ms is None


def test_an_interval_that_decides_is_counted() -> None:
    # 870 ms is 29 ms before the interval's lower end, within the tolerance, and 35 before its upper
    found = judge_by_reference([decided(870, LATE_LABEL), decided(950, LATE_LABEL)])
    assert (found["change_point"].unsure, found["change_point"].width_ms) == (1, 6)
    assert (found["paper"].unsure, found["paper"].width_ms) == (0, None)


def test_without_truth_there_is_no_true_row_and_without_any_onset_no_row() -> None:
    real: onset_references.References = {"paper": reference(1000), "change_point": reference(902)}
    assert list(judge_by_reference([decided(950, real)])) == ["paper", "change_point"]
    assert judge_by_reference([decided(950, {})]) == judge_by_reference([]) == {}


def label(rule: str = "paper", **changed: Any) -> TrialLabel:
    onsets = {"paper": (310, 450), "change_point": (260, 400)}
    none = {"incipient": None, "gross": None}
    parts: dict[str, Any] = {
        name: {"incipient_ns": a * MS, "gross_ns": b * MS, "per_marker_ns": [b * MS, a * MS]}
        | {"doubts": none, "first_marker": 1}
        for name, (a, b) in onsets.items()
    }
    parts["change_point"] |= {"low_ns": [399 * MS, 258 * MS], "high_ns": [401 * MS, 263 * MS]}
    return TrialLabel.model_validate(
        {**parts[rule], **parts, "rule": rule, "end_ns": 600 * MS, **changed}
    )


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    made = Reviewable(tmp_path_factory.mktemp("onsets") / "s", 1)
    return made.recording(made.ids[0])


def truth(monkeypatch: pytest.MonkeyPatch, found: dict[str, Any] | None) -> None:
    monkeypatch.setattr(Recording, "simulation_truth", lambda self: found)


def test_the_true_onset_is_where_sliding_began(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the crossings of 2 pixels in the truth are no onsets of the motion
    known = {"incipient_ns": 309 * MS, "gross_ns": 449 * MS, "first_slip_ns": 259 * MS}
    truth(monkeypatch, {**known, "slip_per_papilla_ns": [398 * MS, 259 * MS]})
    found = references_of(recording, label())
    assert {name: each.slip for name, each in found.items()} == {
        "paper": TrueSlip(310 * MS, 450 * MS, 600 * MS),
        "change_point": TrueSlip(260 * MS, 400 * MS, 600 * MS),
        "true": TrueSlip(259 * MS, 398 * MS, 600 * MS),
    }
    assert found["change_point"].interval_ns == (258 * MS, 263 * MS)
    assert found["paper"].interval_ns is found["true"].interval_ns is None
    truth(monkeypatch, {**known, "slip_per_papilla_ns": [None, 259 * MS]})
    assert "true" not in references_of(recording, label())  # the centre never slipped


def test_real_data_have_no_true_onset(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth(monkeypatch, None)
    assert set(references_of(recording, label())) == {"paper", "change_point"}


def test_doubted_and_absent_onsets_are_lacking(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth(monkeypatch, None)
    points = label().change_point
    doubted = points.model_copy(update={"doubts": OnsetDoubts(gross="it creeps")})
    both = label().model_copy(update={"change_point": doubted})
    assert set(references_of(recording, both)) == {"paper"}
    older = label().model_copy(update={"change_point": None, "paper": None})
    assert set(references_of(recording, older)) == {"paper"}  # the label's own onsets


@pytest.mark.parametrize("rule", ["paper", "change_point"])
def test_the_labels_own_rule_is_as_every_other_figure_has_it(
    rule: str, recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth(monkeypatch, None)
    # a person has set both onsets: the row must agree with the latencies of the report
    adjusted = label(rule).model_copy(update={"incipient_ns": 300 * MS, "gross_ns": 500 * MS})
    found = references_of(recording, adjusted)
    assert found[rule].slip == true_slip(adjusted)  # type: ignore[index]
    assert found[rule].interval_ns is None  # type: ignore[index]
    rejected = label(rule).model_copy(update={"incipient_ns": None, "gross_ns": None})
    assert rule not in references_of(recording, rejected)


def test_an_evaluation_of_before_has_no_figures_by_reference(tmp_path: Path) -> None:
    latency = dict.fromkeys(("mean", "std", "median", "p95", "min", "max"))
    latency |= dict.fromkeys(("n", "missed", "late", "false_early"), 0)
    trials = {
        "false_early_before_ms": [],
        "false_early_rate": {"value": 0, "low": 0, "high": 1},
        "median_with_missed_ms": None,
        "latency_ms": {"incipient": latency, "gross": latency},
        "lead_ms": {**latency, "detected_first": 0},
    }
    older = {"asked": 0.02, "allowed": 0, "choice": 4, "levels": {"incipient": 1.0, "gross": None}}
    older |= {"validation": trials, "test": trials}
    read = DetectorRate.model_validate(older)
    assert read.by_reference == {}
    assert read.to_json() == older
