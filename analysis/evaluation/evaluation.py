"""The evaluation of a store: its inputs and its stored figures."""

from __future__ import annotations

from dataclasses import dataclass

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.onset_references import VERSION as REFERENCES_VERSION
from sliplab.analysis.detectors.predictions import (
    COUNTS,
    COUNTS_VERSION,
    seed_step,
    trial_counts,
)
from sliplab.analysis.detectors.rule_sweep import settled
from sliplab.analysis.evaluation.detectors import DetectorWork, detector_work
from sliplab.analysis.evaluation.trials import score_row, summaries
from sliplab.analysis.evaluation.windows import VERSION as WINDOWS_VERSION
from sliplab.analysis.evaluation.windows import key_inputs, score_windows
from sliplab.analysis.labels.label_errors import label_errors, rules_compared
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import (
    ModelOnDisk,
    choose_model,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.protocols import PlannedTrial
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import Evaluation, TrialScore
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import StoreError, TrialStore


@dataclass(frozen=True)
class EvaluationJob:
    """Everything an evaluation depends on, found before anything is computed."""

    store: TrialStore
    campaigns: list[Collected]
    labels: StoreLabels
    model: ModelOnDisk
    models: list[ModelOnDisk]
    """Models of all seeds, the chosen one included."""
    detection: dict[str, Detection]
    trials: list[tuple[Collected, PlannedTrial, Recording, str]]
    """Campaign, trial, recording and key of its spike counts, of every trial that is scored."""
    detectors: DetectorWork
    key: str

    @property
    def others(self) -> list[ModelOnDisk]:
        """Models of the seeds that were not chosen."""
        return [model for model in self.models if model.seed != self.model.seed]

    def counted_by(self, model: ModelOnDisk, item: Collected) -> list[tuple[str, Recording, str]]:
        """Return campaign, recording and key of spike counts of each trial that is scored."""
        stride = {"stride_ms": self.detection[item.name].stride_ms}
        return [
            (item.name, it, make_key(COUNTS, COUNTS_VERSION, [model.key, it.checksum], stride))
            for known, _, it, _ in self.trials
            if known.name == item.name
        ]


STEP = "evaluation"
VERSION = 4
BY_SEED_VERSION = 2
NAME = "evaluation"
FORMAT = (VERSION, WINDOWS_VERSION)
"""Format version stored in an evaluation, to detect keys of an older version."""


def make_job(
    store: TrialStore,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    reviewed: bool = False,
) -> EvaluationJob:
    """Find the inputs of the evaluation, and its detection settings.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        reviewed: people's decisions are applied to the labels.
    """
    labels = StoreLabels(store, reviewed)
    models = wanted_models(store, campaigns, reviewed)
    model = choose_model(models)
    settings = training_settings(campaigns)
    windows = settings.windows.model_dump(mode="json")
    given = (("margin", margin), ("smoothing", smoothing))
    change: dict[str, float | str] = {name: value for name, value in given if value is not None}
    if change:
        change["choose"] = "protocol"
    rules = rules_of(campaigns, settings.network.outputs_per_class)
    detection, trials, inputs = {}, [], [key_inputs(models, campaigns)]
    for item in campaigns:
        detection[item.name] = Detection.model_validate({**rules[item.name].model_dump(), **change})
        for trial, recording in item.trials:
            if trial.split != "test":
                continue
            if not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            label = labels.key(item, recording)
            counts = make_key(COUNTS, COUNTS_VERSION, [model.key, recording.checksum], windows)
            trials.append((item, trial, recording, counts))
            inputs.append([item.name, trial.id, label, counts])
    used = {name: value.model_dump(mode="json") for name, value in detection.items()}
    detectors = detector_work(labels, campaigns, detection, model.key)
    # decisions on trials other than test trials are counted in the result
    states = labels.states(campaigns)
    of_review = [] if states is None else [states]
    # evaluations of before, which lack the figures by each reference, can be read all the same
    # and so can those of several seeds that have latencies of the chosen one alone
    of_seeds = [BY_SEED_VERSION] if len(models) > 1 else []
    made_of = [model.key, inputs, detectors.inputs, REFERENCES_VERSION, *of_review, *of_seeds]
    key = make_key(STEP, VERSION, made_of, used)
    return EvaluationJob(store, campaigns, labels, model, models, detection, trials, detectors, key)


def evaluation_of(store: TrialStore) -> Evaluation:
    """Return the store's evaluation.

    Raises:
        StoreError: it does not exist, or another version of the program made it.
    """
    saved = Derived.of(store, STEP)
    if saved.key(NAME) is None:
        raise StoreError(f"{store.folder}: nothing evaluated yet; run `sliplab evaluate` first")
    if saved.read(NAME).get("format") != list(FORMAT):
        raise StoreError(
            f"{store.folder}: evaluated by another version of this program; run `sliplab evaluate`"
        )
    return saved.load(NAME, Evaluation)


def _score_trials(
    job: EvaluationJob, detection: dict[str, Detection], other: ModelOnDisk | None = None
) -> list[TrialScore]:
    """One row a trial: onsets, detections, latency.

    Args:
        other: than the chosen model.
    """
    rows = []
    for item, trial, recording, _ in job.trials:
        if other is None:
            found = trial_counts(job.store, item.name, trial.id, detection[item.name])
        else:
            found = Derived.of(job.store, seed_step(other.seed), item.name).arrays(trial.id)
        label = job.labels.read(item, recording)
        rows.append(
            score_row(item, trial, label, found["counts"], found["end_ns"], detection[item.name])
        )
    return rows


def score_store(job: EvaluationJob, train: SampleSet, test: SampleSet) -> None:
    """Score windows, detections and labels, and keep them as one result."""
    settings = training_settings(job.campaigns)
    choices = job.detectors.choices(job.store, job.detection)
    detection = {name: settled(value, choices[name]) for name, value in job.detection.items()}
    kinematic = training_campaigns(job.campaigns)[0].name
    rows = _score_trials(job, detection)
    of_seeds = {job.model.seed: rows}
    of_seeds |= {model.seed: _score_trials(job, detection, model) for model in job.others}
    states = job.labels.states(job.campaigns)
    result = Evaluation(
        format=FORMAT,
        seed=job.model.seed,
        windows=score_windows(
            job.labels,
            job.campaigns,
            job.models,
            job.model,
            job.key,
            train,
            test,
            detection[kinematic].margin,
        ),
        trials=tuple(rows),
        experiments=summaries(rows, of_seeds, job.model.seed),
        label_error_ms=label_errors(job.store, job.campaigns),
        label_rules_ms=rules_compared(job.store, job.campaigns),
        reviewed=None if states is None else {str(name): n for name, n in states.items()},
        detection=detection,
        choices=choices,
        detectors=job.detectors.compare(job.store, settings, job.detection[kinematic]),
    )
    Derived.of(job.store, STEP).write(NAME, job.key, result)
