"""What a detector was worth in each trial, as rows that are kept, and over each experiment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.detection import detect
from sliplab.analysis.detectors.latency import (
    score_trial,
    summarise_latency,
    summarise_lead,
    true_slip,
)
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
