"""Evaluation: what the trained network is worth on trials it has never seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy.typing as npt
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.rule_sweep import settled
from sliplab.analysis.labels.label_errors import label_errors, rules_compared
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.flows.label import report_states
from sliplab.flows.learning import counting, window_scores
from sliplab.flows.learning.counting import COUNTS, count_spikes
from sliplab.flows.learning.detector_trials import predict_trials, predictions_step
from sliplab.flows.learning.detector_work import detector_work
from sliplab.flows.learning.evaluation_job import Job
from sliplab.flows.learning.other_networks import evaluate_comparison
from sliplab.flows.learning.samples import load_samples
from sliplab.flows.learning.train import Model, rules_of, training_settings, wanted_models
from sliplab.flows.learning.trial_scores import score_row, summaries
from sliplab.flows.learning.window_scores import key_inputs, score_windows
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.protocols.settings import Detection
from sliplab.storage.schema.evaluation import Evaluation, TrialScore
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store, StoreError

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

STEP = "evaluation"
VERSION = 4
NAME = "evaluation"
FORMAT = (VERSION, window_scores.VERSION)
"""Stands in an evaluation, so that who reads it knows that its keys are those of today."""


def choose_model(models: list[Model]) -> Model:
    """The model with the best strict validation accuracy; ties go to the first seed.

    Raises:
        StoreError: a model is missing or stale.
    """
    for model in models:
        if not model.fresh:
            raise StoreError(
                f"{model.path}: is missing or stale; run `sliplab train` first, with `--reviewed` "
                "where the evaluation has it"
            )
    return max(models, key=lambda model: model.info.validation.strict or 0.0)


def make_job(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> Job:
    """Find what is to be evaluated, and by what detection settings.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        cluster: what counts spikes and makes samples, instead of this machine.
        reviewed: people's decisions are applied to the labels.
    """
    labels = Labels(store, reviewed)
    models = wanted_models(store, campaigns, reviewed)
    model = choose_model(models)
    settings = training_settings(campaigns)
    windows = settings.windows.model_dump(mode="json")
    change: dict[str, Any] = {"margin": margin, "smoothing": smoothing}
    change = {name: value for name, value in change.items() if value is not None}
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
            counts = make_key(COUNTS, counting.VERSION, [model.key, recording.checksum], windows)
            trials.append((item, trial, recording, counts))
            inputs.append([item.name, trial.id, label, counts])
    used = {name: value.model_dump(mode="json") for name, value in detection.items()}
    detectors = detector_work(labels, campaigns, detection, model.key)
    # what people decided on trials beside the test trials is counted in the result
    states = labels.states(campaigns)
    of_review = [] if states is None else [states]
    key = make_key(STEP, VERSION, [model.key, inputs, detectors.inputs, *of_review], used)
    return Job(store, campaigns, labels, model, models, detection, trials, detectors, key, cluster)


def evaluation_of(store: Store) -> Evaluation:
    """Return the store's evaluation.

    Raises:
        StoreError: there is none, or another version of the program made it.
    """
    kept = Derived.of(store, STEP)
    if kept.key(NAME) is None:
        raise StoreError(f"{store.folder}: nothing evaluated yet; run `sliplab evaluate` first")
    if kept.read(NAME).get("format") != list(FORMAT):
        raise StoreError(
            f"{store.folder}: evaluated by another version of this program; run `sliplab evaluate`"
        )
    return kept.load(NAME, Evaluation)


@task(name="scores", cache_policy=NO_CACHE, persist_result=False)
def score(wanted: Opaque[tuple[Job, SampleSet, SampleSet]]) -> None:
    """Windows, detections and label errors, kept as one result."""
    job, train, test = wanted.content
    settings = training_settings(job.campaigns)
    choices = job.detectors.choices(job.store, job.detection)
    detection = {name: settled(value, choices[name]) for name, value in job.detection.items()}
    kinematic = training_campaigns(job.campaigns)[0].name
    rows = _score_trials(job, detection)
    states = job.labels.states(job.campaigns)
    result = Evaluation(
        format=FORMAT,
        seed=job.model.seed,
        windows=score_windows(job, train, test, detection[kinematic].margin),
        trials=tuple(rows),
        experiments=summaries(rows),
        label_error_ms=label_errors(job.store, job.campaigns),
        label_rules_ms=rules_compared(job.store, job.campaigns),
        reviewed=None if states is None else {str(name): n for name, n in states.items()},
        detection=detection,
        choices=choices,
        detectors=job.detectors.compare(job.store, settings, job.detection[kinematic]),
    )
    Derived.of(job.store, STEP).write(NAME, job.key, result)


def _score_trials(job: Job, detection: dict[str, Detection]) -> list[TrialScore]:
    """One row a trial: onsets, detections, latency."""
    rows = []
    for item, trial, recording, _ in job.trials:
        found = trial_counts(job.store, item.name, trial.id, detection[item.name])
        label = job.labels.read(item, recording)
        rows.append(
            score_row(item, trial, label, found["counts"], found["end_ns"], detection[item.name])
        )
    return rows


def trial_counts(
    store: Store, campaign: str, trial_id: str, settings: Detection
) -> dict[str, npt.NDArray[Any]]:
    """``counts`` int64 (n, 3) and ``end_ns`` int64 (n,) of a scored trial, at its stride."""
    step = COUNTS if settings.stride_ms is None else predictions_step(settings.stride_ms)
    return Derived.of(store, step, campaign).arrays(trial_id)


@flow(name="evaluate", validate_parameters=False, persist_result=False)
def evaluate_flow(wanted: Opaque[Job]) -> None:
    """Count spikes where needed, then score."""
    job = wanted.content
    with timed(job.store, "evaluate"):
        count_spikes(
            job.store,
            job.model.path,
            training_settings(job.campaigns).windows,
            [(item.name, recording, key) for item, _, recording, key in job.trials],
            job.cluster,
        )
        windows = training_settings(job.campaigns).windows
        predict_trials(job.store, job.model.path, windows, job.detectors.wanted, job.cluster)
        train, test = (
            load_samples(job.labels, job.campaigns, split, job.cluster)
            for split in ("train", "test")
        )
        score(Opaque((job, train, test)))


def evaluate(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> dict[str, Any]:
    """Evaluate if any input or setting changed; also the network that `analysis.also` names."""
    training_campaigns(campaigns)
    job = make_job(store, campaigns, margin, smoothing, cluster, reviewed)
    stale = not Derived.of(store, STEP).fresh(NAME, job.key)
    if stale:
        run(evaluate_flow, Opaque(job), cluster)
    stale |= evaluate_comparison(store, campaigns, cluster, reviewed)
    return {
        "step": "evaluate",
        "done": int(stale),
        "fresh": int(not stale),
        **report_states(job.labels, campaigns),
    }
