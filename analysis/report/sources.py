"""Results of earlier steps that a report is made of, and the key of them all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.onset_references import References, references_of
from sliplab.analysis.evaluation import baselines as window_baselines
from sliplab.analysis.evaluation import networks as other_networks
from sliplab.analysis.evaluation import windows as window_scores
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.labels import label_errors
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import training_settings
from sliplab.analysis.report.clocks import PAGE as CLOCKS
from sliplab.analysis.report.plugin_sections import sections_key
from sliplab.analysis.report.programs import read_programs
from sliplab.analysis.report.registration import registration_key
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.evaluation import (
    Evaluation,
    LabelCheck,
    OtherEvaluation,
    TrainedBaseline,
    WindowIntervals,
)
from sliplab.storage.schema.summary import HoldSummary
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import TrialStore

STEP = "report"
VERSION = 14


def report_folder(store: TrialStore) -> Path:
    """Return the folder of the report."""
    return store.folder / "report"


@dataclass(frozen=True)
class Sources:
    """Results of earlier steps that a summary is made of.

    Attributes:
        settings: of training.
        networks: results of other networks, by name.
        baselines: of other methods, by name; window_intervals: of the test windows.
        label_check: of labels with video; holds: slips in the hold, by campaign.
        planned_bytes: of the committed trials, by campaign.
        step_seconds: wall time of each step.
        references: slips of the test trials by each onset, by campaign and trial.
        programs: results of other programs, by name.
    """

    store: TrialStore
    campaigns: Sequence[Collected]
    settings: AnalysisSettings
    evaluation: Evaluation
    networks: Mapping[str, OtherEvaluation]
    baselines: Mapping[str, TrainedBaseline]
    window_intervals: WindowIntervals | None
    label_check: LabelCheck | None
    holds: Mapping[str, HoldSummary]
    planned_bytes: Mapping[str, int]
    step_seconds: Mapping[str, float]
    programs: Mapping[str, Json]
    references: Mapping[tuple[str, str], References]


def report_key(store: TrialStore, campaigns: list[Collected]) -> str:
    """Return the key of all that the report is made of.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluation = evaluation_of(store)
    collected = [
        [
            item.name,
            item.title,
            item.question,
            item.planned.collection_hash,
            len(item.campaign.quarantined()),
            [recording.checksum for _, recording in item.trials],
        ]
        for item in campaigns
    ]
    reviewed = evaluation.reviewed is not None
    others = other_networks.retained(store, campaigns, reviewed).values()
    inputs = [
        evaluation.key,
        collected,
        (report_folder(store) / CLOCKS).exists(),
        sorted(found.key for found in others),
        window_baselines.slip_methods().fresh_keys(store),
        read_programs(store),
        Derived.of(store, label_errors.CHECK).key(label_errors.CHECK),
        # commands in the page name the store's folder
        str(store.folder.resolve()),
        *sections_key(store, campaigns),
        *registration_key(store, campaigns),
    ]
    return make_key(STEP, VERSION, inputs, None)


def read_sources(
    store: TrialStore,
    campaigns: list[Collected],
    planned_bytes: Mapping[str, int],
    step_seconds: Mapping[str, float],
) -> Sources:
    """Read the results that earlier steps stored.

    Args:
        planned_bytes, step_seconds: as of `Sources`.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluation = evaluation_of(store)
    labels = StoreLabels(store, evaluation.reviewed is not None)
    return Sources(
        store,
        campaigns,
        settings=training_settings(campaigns),
        evaluation=evaluation,
        networks=other_networks.retained(store, campaigns, labels.reviewed),
        baselines=window_baselines.slip_methods().results(store),
        window_intervals=window_scores.window_intervals(store, evaluation.key),
        label_check=label_errors.read_check(store),
        holds=label_errors.holds_compared(store, campaigns),
        planned_bytes=planned_bytes,
        step_seconds=step_seconds,
        programs=read_programs(store),
        references={
            (item.name, trial.id): references_of(recording, labels.read(item, recording))
            for item in campaigns
            for trial, recording in item.of_split("test")
        },
    )
