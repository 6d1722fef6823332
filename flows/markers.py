"""Training and evaluation of a store without events: a classifier on marker displacements."""

from __future__ import annotations

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation import evaluation
from sliplab.analysis.evaluation.markers import (
    MarkerJob,
    evaluate_markers,
    make_marker_job,
    train_marker_model,
    wanted_marker_models,
)
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.windows.displacement import MarkerSamples, load_marker_samples
from sliplab.flows.label import report_states
from sliplab.flows.running import console
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store


def train_on_markers(
    store: Store, campaigns: list[Collected], reviewed: bool = False
) -> StepResult:
    """Train missing or stale networks; see `train.train`. It takes seconds on this machine.

    Raises:
        StoreError: labels or samples are missing.
    """
    labels = StoreLabels(store, reviewed)
    models = wanted_marker_models(labels, campaigns)
    stale = [model for model in models if not model.fresh]
    if stale:
        run(train_markers_flow, Opaque((labels, campaigns, stale)))
    return {
        "step": "train",
        "done": len(stale),
        "fresh": len(models) - len(stale),
        **report_states(labels, campaigns),
    }


@flow(name="train on markers", validate_parameters=False, persist_result=False)
def train_markers_flow(
    argument: Opaque[tuple[StoreLabels, list[Collected], list[ModelOnDisk]]],
) -> None:
    """Train the missing and stale seeds one after another."""
    labels, campaigns, models = argument.content
    with timed(labels.store, "train"):
        train, validation = (
            load_marker_samples(labels, campaigns, split) for split in ("train", "validation")
        )
        for model in models:
            train_one_on_markers(Opaque((model, train, validation)))


@task(name="train one seed on markers", cache_policy=NO_CACHE, persist_result=False)
def train_one_on_markers(job: Opaque[tuple[ModelOnDisk, MarkerSamples, MarkerSamples]]) -> int:
    """Train and store one classifier."""
    model, train, validation = job.content
    net = train_marker_model(model, train, validation)
    strict = model.info.validation.strict
    shown = "" if strict is None else f", validation {100 * strict:.1f} %"
    console.say(f"{model.title}: {net.title}; epoch {net.chosen_epoch}{shown}")
    return model.seed


def evaluate_on_markers(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    reviewed: bool = False,
) -> StepResult:
    """Evaluate if any input or setting changed; see `evaluate.evaluate`."""
    job = make_marker_job(StoreLabels(store, reviewed), campaigns, margin, smoothing)
    stale = not Derived.of(store, evaluation.STEP).fresh(evaluation.NAME, job.key)
    if stale:
        run(evaluate_markers_flow, Opaque(job))
    return {
        "step": "evaluate",
        "done": int(stale),
        "fresh": int(not stale),
        **report_states(job.labels, campaigns),
    }


@flow(name="evaluate on markers", validate_parameters=False, persist_result=False)
def evaluate_markers_flow(argument: Opaque[MarkerJob]) -> None:
    """Evaluate windows, detections and labels."""
    job = argument.content
    with timed(job.labels.store, "evaluate"):
        evaluate_markers(job)
