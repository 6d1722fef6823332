"""The classifier on marker displacements in the report, where there are no events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.evaluation import NAME, STEP, evaluation_of
from sliplab.analysis.evaluation.windows import window_intervals
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.report.alarms import alarm_words
from sliplab.analysis.report.latency import latency_section
from sliplab.analysis.report.outcomes import failure_section
from sliplab.analysis.report.page import Content, Figure, Table, percent
from sliplab.analysis.report.summary import judged_part, plain_rules
from sliplab.analysis.report.windows import (
    METHODS,
    class_table,
    confusion_figure,
    points_words,
    training_figure,
    warned_words,
    where_section,
)
from sliplab.plugins.markers import marker_net
from sliplab.plugins.markers.evaluation import make_marker_job
from sliplab.plugins.markers.marker_net import MarkerNet
from sliplab.storage.schema.evaluation import (
    Accuracy,
    Evaluation,
    MarkerClassifier,
    Seeds,
    Share,
)
from sliplab.storage.schema.summary import Kinematic, OneCameraSummary
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import StoreError, TrialStore


@dataclass(frozen=True)
class EvaluatedClassifier:
    """A store's classifier and its evaluation."""

    net: MarkerNet
    evaluation: Evaluation


def read_judged(store: TrialStore, campaigns: list[Collected]) -> EvaluatedClassifier | None:
    """Read the classifier and its evaluation; None where either is missing or stale."""
    stored = Derived.of(store, STEP)
    if stored.key(NAME) is None:
        return None
    try:
        evaluation = evaluation_of(store)
        rules = evaluation.detection.values()
        stated = next((rule for rule in rules if rule.choose == "protocol"), None)
        labels = StoreLabels(store, evaluation.reviewed is not None)
        jobs = [make_marker_job(labels, campaigns)]
        if stated is not None:  # the rule was given on the command line
            jobs.append(make_marker_job(labels, campaigns, stated.margin, stated.smoothing))
        for job in jobs:
            if stored.fresh(NAME, job.key):
                return EvaluatedClassifier(marker_net.load(job.model.path), evaluation)
    except StoreError:
        return None
    return None


def with_classifier(
    summary: OneCameraSummary,
    store: TrialStore,
    campaigns: list[Collected],
    judged: EvaluatedClassifier,
) -> OneCameraSummary:
    """Add the classifier's figures, under the names that the spiking network's have."""
    evaluation = judged.evaluation
    parts = judged_part(campaigns, evaluation, window_intervals(store, evaluation.key), {}, {}, {})
    return OneCameraSummary.model_validate(
        {
            **summary.to_json(),
            **parts,
            "classifier": evaluation.classifier,
            "detection": plain_rules(evaluation.detection),
            "choices": evaluation.choices,
        }
    )


@dataclass(frozen=True)
class MarkerNetworkSection(Content):
    """Accuracy on windows of test trials, compared with simple methods."""

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    classifier: MarkerClassifier
    accuracy: Accuracy
    interval: Share
    alarms: str
    seeds: Seeds
    rules: Sequence[str]
    confusion: Figure
    training: Figure
    methods: Table
    classes: Table

    @property
    def strict(self) -> str:
        """Strict accuracy with its interval."""
        return warned_words(self.interval)


def _frames(smoothing: int) -> str:
    return "a frame" if smoothing == 1 else f"the mean of {smoothing} frames"


def _network_section(
    kinematic: Kinematic, summary: OneCameraSummary, net: MarkerNet
) -> MarkerNetworkSection:
    assert summary.classifier is not None
    simulated, accuracy = summary.simulated, kinematic.accuracy
    history = [asdict(epoch) for epoch in net.history]
    own = [percent(value) for value in (accuracy.argmax, accuracy.strict, accuracy.margin)]
    return MarkerNetworkSection(
        summary.classifier,
        accuracy,
        kinematic.interval,
        alarm_words(kinematic.false_alarms),
        kinematic.seeds,
        sorted(
            {
                f"{_frames(rule.smoothing)} leads by {rule.margin:g} points"
                for rule in summary.detection.values()
            }
        ),
        confusion_figure(kinematic, simulated=simulated),
        training_figure(history, net.chosen_epoch, simulated=simulated),
        Table(
            ["method", "argmax", "strict", "margin", "classifier ahead by (points)"],
            [["marker classifier", *own, ""]]
            + [
                [METHODS[name], percent(found.argmax), "", "", points_words(found.network_ahead)]
                for name, found in kinematic.beside.items()
            ],
        ),
        class_table(kinematic),
    )


def marker_sections(
    store: TrialStore,
    campaigns: list[Collected],
    summary: OneCameraSummary,
    judged: EvaluatedClassifier,
) -> list[Content]:
    """Make the sections about the classifier, in order."""
    assert summary.kinematic is not None
    rows = judged.evaluation.trials
    sections = [
        _network_section(summary.kinematic, summary, judged.net),
        where_section(summary.kinematic, simulated=summary.simulated),
        *(
            latency_section(experiment, campaigns, rows, summary)
            for experiment in ("kinematic", "gravity", "disturbance")
        ),
        failure_section(store.folder, summary.trials),
    ]
    return [section for section in sections if section is not None]
