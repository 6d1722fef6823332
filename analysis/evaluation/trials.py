"""Detections of single trials against their labels, and latencies over each experiment."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.latency import (
    score_trial,
    summarise_latency,
    summarise_lead,
    true_slip,
)
from sliplab.analysis.detectors.predictions import window_counts
from sliplab.analysis.detectors.smoothing_rule import detect
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.analysis.networks import training
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.protocols import PlannedTrial
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import (
    AlarmRate,
    ExperimentScores,
    SeedTimes,
    TrialLatency,
    TrialScore,
)
from sliplab.storage.schema.holdout import HoldoutScores
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore


def score_row(
    item: Collected,
    trial: PlannedTrial,
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
        condition=item.describe(trial),
        incipient_ns=label.incipient_ns,
        gross_ns=label.gross_ns,
        end_ns=None if slip is None else slip.end_ns,
        detected_incipient_ns=detections.incipient_ns,
        detected_gross_ns=detections.gross_ns,
        latency=latency,
    )


def summaries(
    rows: Sequence[TrialScore],
    of_seeds: Mapping[int, Sequence[TrialScore]] | None = None,
    chosen: int | None = None,
) -> dict[str, ExperimentScores]:
    """Latency and lead by experiment, of rows of `score_row`.

    Args:
        of_seeds: the same trials by every trained network, that of the seed `chosen` among them.
    """
    seeds = of_seeds if of_seeds is not None and len(of_seeds) > 1 else {}
    result = {}
    for experiment in ("kinematic", "gravity", "disturbance"):
        ours = [row for row in rows if row.experiment == experiment]
        scored = _scored(rows, experiment)
        found = ExperimentScores(
            trials=len(ours),
            without_onsets=len(ours) - len(scored),
            latency_ms=summarise_latency(scored),
            lead_ms=summarise_lead(scored),
        )
        by_seed = tuple(
            SeedTimes(
                seed=seed,
                chosen=seed == chosen,
                latency_ms=summarise_latency(times),
                lead_ms=summarise_lead(times),
            )
            for seed, theirs in sorted(seeds.items())
            for times in [_scored(theirs, experiment)]
        )
        result[experiment] = found.model_copy(update={"by_seed": by_seed}) if by_seed else found
    return result


def _scored(rows: Sequence[TrialScore], experiment: str) -> list[TrialLatency]:
    """Return the latencies of an experiment's trials that have both onsets."""
    return [row.latency for row in rows if row.experiment == experiment and row.latency is not None]


def item_trials(
    campaigns: Sequence[Collected], rows: Iterable[TrialScore]
) -> Iterator[tuple[TrialScore, Recording]]:
    """Yield rows of an evaluation with their recordings, of those test trials that are there."""
    known = {(row.campaign, row.trial): row for row in rows}
    for item in campaigns:
        for trial, recording in item.of_split("test"):
            if (item.name, trial.id) in known:
                yield known[item.name, trial.id], recording


def quiet_alarms(trials: Iterable[tuple[TrialScore, Recording]]) -> AlarmRate | None:
    """Return false early detections of slides by the hour before slip; None without such trials.

    A trial has one detection: its time ends with a false one, else with the onset of its label.

    Args:
        trials: rows of `score_row` with their recordings; other experiments are left out.
    """
    alarms, hours = [], []
    for row, recording in trials:
        if row.experiment != "kinematic" or row.latency is None:
            continue
        false = row.latency.false_early_incipient
        end_ns = row.detected_incipient_ns if false else row.incipient_ns
        if end_ns is not None and (time := end_ns - dataset.recorded_span(recording)[0]) > 0:
            alarms.append(int(false))
            hours.append(time / 3.6e12)
    return alarm_rate(alarms, hours) if hours else None


@dataclass(frozen=True)
class EvaluatedTrials:
    """Outputs of a network and a rule on a store's test trials.

    Attributes:
        counts: spikes of each class in each sample, int64 (n, 3).
        samples: of the kinematic test trials.
        trials: a row of `score_row` for each, and its recording.
    """

    counts: npt.NDArray[np.int64]
    samples: dataset.SampleSet
    trials: list[tuple[TrialScore, Recording]]

    @property
    def rows(self) -> list[TrialScore]:
        """Onsets, detections and latency of each trial."""
        return [row for row, _ in self.trials]

    def hits_by_trial(self, with_campaign: bool) -> dict[str, tuple[int, int]]:
        """Return by trial its windows that were classified correctly, and all of its windows.

        Args:
            with_campaign: prefix the trial's name with the campaign.
        """
        trial, known = self.samples.trial, self.samples.trials
        names = [f"{c}/{name}" if with_campaign else name for c, name in known]
        hits = window_groups.strict_hits(self.counts, self.samples.y)
        right = np.bincount(trial, hits, len(names))
        count = np.bincount(trial, minlength=len(names))
        return {name: (int(right[k]), int(count[k])) for k, name in enumerate(names)}

    def window_scores(self, margin: float) -> HoldoutScores:
        """Return all figures of the windows, with two accuracies over trials.

        Args:
            margin: spikes by which the winning class must lead.
        """
        counts, y, trial = self.counts, self.samples.y, self.samples.trial
        return HoldoutScores(
            **dict(metrics.score(counts, y, margin)),
            strict=window_groups.share(window_groups.strict_hits(counts, y), trial),
            argmax=window_groups.share(metrics.credit(counts, y), trial),
        )


def judge(
    fitted: Fitted,
    detection: Mapping[str, Detection],
    store: TrialStore,
    campaigns: list[Collected],
) -> EvaluatedTrials:
    """Score the labelled test trials of a store by a network that another store trained.

    Args:
        detection: smoothing, margin and stride by campaign.
    """
    labels, rows = StoreLabels(store), []
    for item in campaigns:
        settings = detection[item.name]
        for trial, recording in item.of_split("test"):
            counts, end_ns = window_counts(recording, fitted, settings.stride_ms)
            of_trial = labels.read(item, recording)
            row = score_row(item, trial, of_trial, counts, end_ns, settings)
            rows.append((row, recording))
    samples = load_samples(labels, training_campaigns(campaigns), "test")
    return EvaluatedTrials(training.predict_counts(fitted, samples.windows), samples, rows)
