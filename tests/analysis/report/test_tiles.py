"""Headline numbers: gross slip, smallest leads, false alarms and seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import pytest

from sliplab.analysis.detectors.latency import summarise_latency, summarise_lead
from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.analysis.report.latency import smallest_lead
from sliplab.analysis.report.outcomes import trial_intervals
from sliplab.analysis.report.page import with_interval
from sliplab.analysis.report.seeds import seed_words
from sliplab.analysis.report.tiles import slip_tiles
from sliplab.protocols.detection import Detection
from sliplab.storage.schema import evaluation
from sliplab.storage.schema.evaluation import Accuracy, AlarmRate, Seeds, SeedScores, TrialLatency
from sliplab.storage.schema.summary import (
    Experiment,
    Kinematic,
    NetworkSummary,
    Summary,
    TrialOutcome,
)


def seeds(*strict: float) -> Seeds:
    each = tuple(
        SeedScores(seed=k, chosen=not k, validation_strict=None, strict=it, argmax=it, margin=it)
        for k, it in enumerate(strict)
    )
    spread = evaluation.SeedSpread(mean=sum(strict) / len(strict), min=min(strict), max=max(strict))
    return Seeds(each=each, spread={"strict": spread})


def outcome(experiment: str, lead_ms: float | None, gross: str) -> TrialOutcome:
    times = {"lead_ms": lead_ms, "latency_gross_ms": 20.0 if gross == "detected" else None}
    times |= {"duration_ms": 900.0, "latency_incipient_ms": None if lead_ms is None else 90.0}
    became = {"outcome": "missed" if lead_ms is None else "detected_first", "gross": gross}
    names = {"campaign": "c", "experiment": experiment, "trial": f"{experiment} {lead_ms}"}
    return TrialOutcome.model_validate(names | became | times)


TIMES = ("latency_incipient_ms", "latency_gross_ms", "lead_ms")


def latency(row: TrialOutcome) -> TrialLatency:
    return TrialLatency(
        **{name: getattr(row, name) for name in TIMES},
        late_incipient_ms=None,
        late_gross_ms=500.0 if row.gross == "late" else None,
        missed_incipient=row.outcome == "missed",
        missed_gross=row.gross == "missed",
        false_early_incipient=False,
        false_early_gross=row.gross == "false_early",
    )


def figures(rows: Sequence[TrialOutcome]) -> dict[str, Any]:
    scored = [latency(row) for row in rows]
    found = {"latency_ms": summarise_latency(scored), "lead_ms": summarise_lead(scored)}
    return {"trials": len(rows), "by_seed": (), **found}


def summary(alarms: dict[str, AlarmRate], of_seeds: Seeds) -> Summary:
    slides = [outcome("kinematic", 4000.0, kind) for kind in ("detected", "detected")]
    slides += [outcome("kinematic", None, "false_early")]
    falls = [outcome("gravity", lead, "late") for lead in (71.0, 560.0, 611.0, 700.0)]
    kinematic = Kinematic.model_construct(
        accuracy=Accuracy(argmax=0.91, strict=0.9, margin=0.8, n=450),
        seeds=of_seeds,
        interval=evaluation.Share(share=0.9, low=0.8, high=0.95, n=450, trials=3),
        false_alarms=alarms,
        **figures(slides),
    )
    gravity = Experiment.model_construct(**figures(falls))
    preset = NetworkSummary.model_construct(
        title="", preset="paper", gravity=Experiment.model_construct(**figures(falls[2:]))
    )
    return Summary.model_construct(
        kinematic=kinematic,
        gravity=gravity,
        trials=(*slides, *falls),
        disturbance=Experiment.model_construct(**figures([])),
        networks={"paper": preset},
    )


QUIET = {"quiet": alarm_rate([1, 1, 0], [0.01, 0.01, 0.005])}


def test_tiles_name_trials_gross_detections_and_the_cost_of_accuracy() -> None:
    tiles = {it.name: it for it in slip_tiles(summary(QUIET, seeds(0.9)), "; clocks")}
    accuracy = tiles["window accuracy"]
    assert accuracy.note.startswith("strict, n = 3 trials (450 windows); one network")
    assert "another seed would give other figures" in accuracy.note
    alarms = tiles["false alarms an hour"]
    assert alarms.value == "80.0 (9.7 to 289.0)"
    assert "3 trials, 0.025 h; under nuisances not measured (sliplab stress)" in alarms.note
    gross = tiles["gross slip in time"]
    assert gross.value == "2 of 7"
    assert gross.note == (
        "kinematic 2 of 3, 1 false early; "
        "gravity 0 of 4, 4 of 4 gross detections came after the plate had stopped"
    )
    assert tiles["incipient latency"].note == (
        "median of 3 trials; 1 missed, 0 late, 0 false early; clocks"
    )


def test_smallest_lead_names_the_next_one_and_the_presets() -> None:
    said = smallest_lead(summary(QUIET, seeds(0.9)), "gravity")
    assert said == (
        "71 ms, in one trial of 4 (the next 560 ms, half above 586 ms); the paper preset 611 ms"
    )


def test_seeds_are_each_shown_with_their_range() -> None:
    assert seed_words(seeds(0.92, 0.9, 0.95)) == (
        "3 seeds from 90.0 to 95.0 % strict (0: 92.0 %, 1: 90.0 %, 2: 95.0 %)"
    )


@pytest.mark.parametrize("lost", [1, 3, 5])
def test_missed_trials_count_in_medians_and_their_intervals(lost: int) -> None:
    rows = [outcome("gravity", 600.0 + k, "detected") for k in range(7)]
    rows += [outcome("gravity", None, "late")] * lost
    found = summarise_lead([latency(row) for row in rows])
    every = sorted([600.0 + k for k in range(7)] + [-math.inf] * lost)
    middle = len(every) // 2
    expected = every[middle] if len(every) % 2 else (every[middle - 1] + every[middle]) / 2
    assert found.median == pytest.approx(expected)
    assert found.n == 7
    assert found.min == 600.0
    spans = trial_intervals(rows)
    assert spans.lead_ms.n == 7
    assert spans.lead_ms.median is not None
    assert spans.latency_incipient_ms.median is not None
    if lost > 1:
        assert spans.lead_ms.median[0] is None, "no lower bound"
        assert spans.latency_incipient_ms.median[1] is None, "no upper bound"
    # gross slip was late in as many of the trials as were missed
    gross = summarise_latency([latency(row) for row in rows]).gross
    assert (gross.n, gross.late, gross.median) == (7, lost, 20.0)


def test_median_of_lost_detections_alone_has_no_interval() -> None:
    spans = trial_intervals([outcome("gravity", None, "missed")] * 6)
    assert spans.lead_ms.median is spans.latency_incipient_ms.median is None


def test_open_end_of_an_interval_has_its_sign() -> None:
    assert with_interval(600.0, (None, None), 0, "ms") == "600 (-∞ to ∞) ms"


def test_median_of_half_lost_detections_is_none() -> None:
    rows = [outcome("gravity", 600.0, "detected"), outcome("gravity", None, "late")]
    scored = [latency(row) for row in rows]
    assert summarise_lead(scored).median is None
    assert summarise_latency(scored).gross.median is None
    assert summarise_latency(scored).gross.mean == 20.0


def test_no_interval_reaches_below_what_can_be() -> None:
    rows = [outcome("gravity", lead, "detected") for lead in (10.0, 20.0, 900.0)]
    rows = [
        row.model_copy(update={"latency_gross_ms": ms})
        for row, ms in zip(rows, (-20.0, 0.0, 200.0), strict=True)
    ]
    found = trial_intervals(rows, [Detection(false_early_ms=30)])
    assert found.lead_ms.mean[0] == 0.0
    assert found.latency_gross_ms.mean[0] == -30.0
    free = trial_intervals(rows)
    assert free.latency_gross_ms.mean[0] is not None
    assert free.latency_gross_ms.mean[0] < -30.0
