"""Detections of single trials against their labels, and latencies over each experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.latency import (
    score_trial,
    summarise_latency,
    summarise_lead,
    true_slip,
)
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks import training
from sliplab.analysis.networks.models import rules_of
from sliplab.analysis.networks.quantised import Quantised, chip_run, quantised_net
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows import dataset
from sliplab.protocols import Trial
from sliplab.protocols.settings import Detection
from sliplab.storage.schema.evaluation import ExperimentScores, TrialScore
from sliplab.storage.schema.label import TrialLabel


def score_row(
    item: Collected,
    trial: Trial,
    label: TrialLabel,
    counts: npt.NDArray[Any],
    end_ns: npt.NDArray[Any],
    settings: Detection,
) -> TrialScore:
    """Onsets, detections and latency of a trial; ``latency`` is None without both onsets.

    Args:
        label: see `analysis.detectors.latency.true_slip`.
        counts, end_ns: spikes of consecutive windows (n, 3), and where these end (n,), ns.
    """
    detections = detect(counts, end_ns, settings)
    slip = true_slip(label)
    latency = None
    if slip is not None:
        tolerance = round(settings.false_early_ms * 1e6)
        latency = score_trial(detections, slip, tolerance)
    return TrialScore(
        campaign=item.name,
        experiment=item.experiment,
        trial=trial.id,
        condition=item.plan.describe(trial),
        incipient_ns=label.incipient_ns,
        gross_ns=label.gross_ns,
        end_ns=None if slip is None else slip.end_ns,
        detected_incipient_ns=detections.incipient_ns,
        detected_gross_ns=detections.gross_ns,
        latency=latency,
    )


def summaries(rows: Sequence[TrialScore]) -> dict[str, ExperimentScores]:
    """Latency and lead by experiment, of rows of `score_row`."""
    result = {}
    for experiment in ("kinematic", "gravity", "disturbance"):
        ours = [row for row in rows if row.experiment == experiment]
        scored = [row.latency for row in ours if row.latency is not None]
        result[experiment] = ExperimentScores(
            trials=len(ours),
            without_onsets=len(ours) - len(scored),
            latency_ms=summarise_latency(scored),
            lead_ms=summarise_lead(scored),
        )
    return result


Latency = dict[str, Any]
"""For each experiment ``trials`` with both onsets, and ``latency_ms`` of `summarise_latency`."""


def latencies(
    campaigns: list[Collected],
    labels: Labels,
    fitted: Fitted,
    whole: Quantised,
    on_trial: Callable[[], None] = lambda: None,
) -> tuple[Latency, Latency]:
    """Latency over the test trials of `campaigns`, as trained and with the whole numbers.

    Args:
        on_trial: called before each of them; some thousand windows take a second.
    """
    rules = rules_of(campaigns, fitted.network.outputs_per_class)
    fast, chip = training.engine(fitted), quantised_net(fitted, whole)
    found: tuple[dict[str, list[Any]], ...] = ({}, {})
    for item in campaigns:
        rule = rules[item.name]
        for _, recording in item.of_split("test"):
            on_trial()
            slip = true_slip(labels.read(item, recording))
            if slip is None:
                continue
            x, end_ns = dataset.trial_windows(recording, fitted.windows)
            both = fast.counts(x), chip_run(chip, x.dense()).counts
            for rows, counts in zip(found, both, strict=True):
                said = detect(counts, end_ns, rule)
                scored = score_trial(said, slip, round(rule.false_early_ms * 1e6))
                rows.setdefault(item.experiment, []).append(scored)
    real, chips = map(_summary, found)
    return real, chips


def _summary(rows: dict[str, list[Any]]) -> Latency:
    return {
        experiment: {"trials": len(each), "latency_ms": summarise_latency(each).to_json()}
        for experiment, each in rows.items()
    }
