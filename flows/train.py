"""Training: the network of every seed, from the labelled trials of the kinematic campaigns.

Campaigns without events train a classifier on marker displacements instead (`flows.markers`). Those
of recordings that show other classes than slip's train a network of as many outputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import (
    Collected,
    agreeing,
    missing_stream,
    of_classes,
    training_campaigns,
)
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks import gradients, model_file, training
from sliplab.analysis.networks.models import (
    ModelOnDisk,
    begun,
    comparison_models,
    wanted_class_models,
    wanted_models,
)
from sliplab.analysis.trial_work import Done, EachTrial, Make, TrialWork, in_order
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_class_samples, load_samples
from sliplab.flows.label import report_states
from sliplab.flows.markers import train_on_markers
from sliplab.flows.running import console
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.parallel_map import each_trial
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.ui.train_view import training_progress
from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_bytes, write_json
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.model import ModelSamples, TrainedModel, ValidationAccuracy
from sliplab.storage.trials.store import Store, StoreError

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


@task(name="train one seed", cache_policy=NO_CACHE, persist_result=False)
def train_one(job: Opaque[tuple[ModelOnDisk, SampleSet, SampleSet, bool]]) -> int:
    """Train and store one network."""
    model, train, validation, simulated = job.content
    settings = model.settings
    model.path.parent.mkdir(parents=True, exist_ok=True)
    with training_progress(model, settings.training.epochs, simulated) as progress:
        fitted = training.fit(
            train.windows,
            train.y,
            validation.windows,
            validation.y,
            settings.network,
            settings.windows,
            settings.training,
            model.seed,
            on_epoch=progress.epoch,
            on_state=partial(write_bytes, model.state_path),
            state=begun(model),
            classes=model.classes or CLASSES,
        )
    for warning in fitted.warnings:
        console.say(f"warning: {warning}")
    _keep(model, fitted, ModelSamples(train=len(train), validation=len(validation)))
    if model.classes:
        console.say(
            f"{model.title}: {len(train)} windows of {len(model.classes)} classes; epoch "
            f"{fitted.chosen_epoch}, validation {100 * fitted.chosen.val_strict:.1f} %"
        )
    return model.seed


@uninterrupted
def _keep(model: ModelOnDisk, fitted: training.Fitted, samples: ModelSamples) -> None:
    """Write a network and its description, and delete the states of its training."""
    model_file.save(model.path, fitted)
    info = TrainedModel(
        key=model.key,
        seed=model.seed,
        samples=samples,
        chosen_epoch=fitted.chosen_epoch,
        validation=ValidationAccuracy(
            argmax=fitted.chosen.val_argmax,
            strict=fitted.chosen.val_strict,
            margin=fitted.chosen.val_margin,
        ),
        warnings=fitted.warnings,
    )
    write_json(model.info_path, info.to_json())
    for left in model.path.parent.glob(f"{model.path.stem}.*.state"):
        left.unlink()


@flow(name="train", validate_parameters=False, persist_result=False)
def train_flow(
    argument: Opaque[tuple[StoreLabels, list[Collected], list[ModelOnDisk], Cluster | None]],
) -> int:
    """Train the missing and stale seeds one after another."""
    labels, campaigns, models, cluster = argument.content
    simulated = any(r.simulated for item in campaigns for _, r in item.trials[:1])
    load = load_class_samples if models[0].classes else load_samples
    with timed(labels.store, "train"):
        train, validation = (
            load(labels, campaigns, split, sample_maker(labels.store, split, cluster))
            for split in ("train", "validation")
        )
        for name, part in (("training", train), ("validation", validation)):
            if not len(part):
                raise StoreError(f"there are no {name} samples; collect more trials")
        _warn_of_missing(models[0].classes, train)
        for model in models:
            train_model = train_one.with_options(task_run_name=f"train {model.title}")
            train_model(Opaque((model, train, validation, simulated)))
    return len(models)


def train(
    store: Store,
    campaigns: list[Collected],
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> StepResult:
    """Train missing or stale networks.

    Args:
        cluster: what makes the samples; this machine trains.
        reviewed: people's decisions are applied to the labels.

    Raises:
        StoreError: labels or samples are missing.
        InputError: there is no such device to train on.
    """
    if not of_classes(campaigns) and missing_stream(campaigns) == "events":
        return train_on_markers(store, campaigns, reviewed)
    labels = StoreLabels(store, reviewed)
    if of_classes(campaigns):
        used = agreeing(campaigns)
        models = wanted_class_models(store, used, reviewed)
    else:
        used = training_campaigns(campaigns)
        models = [
            *wanted_models(store, campaigns, reviewed),
            *comparison_models(store, campaigns, reviewed),
        ]
    stale = [model for model in models if not model.fresh]
    if stale:
        _check_device(used[0])
        run(train_flow, Opaque((labels, campaigns, stale, cluster)), cluster)
    return {
        "step": "train",
        "done": len(stale),
        "fresh": len(models) - len(stale),
        **report_states(labels, campaigns),
    }


def _warn_of_missing(classes: tuple[str, ...], train: SampleSet) -> None:
    """Warn of classes that a network cannot learn."""
    there = set(np.unique(train.y).tolist())
    missing = [name for number, name in enumerate(classes) if number not in there]
    if missing:
        console.say(
            f"warning: no training samples of {', '.join(missing)}: the network cannot learn "
            + ("it" if len(missing) == 1 else "them")
        )


def _check_device(item: Collected) -> None:
    device, there = item.settings.training.device, gradients.devices()
    if device not in there:
        raise InputError(
            item.campaign.protocol_file,
            "analysis.training.device",
            device,
            f"not available here; must be one of {', '.join(there)}",
        )


def sample_maker(store: Store, split: str, cluster: Cluster | None) -> EachTrial:
    """Return what makes the samples of a split: this process, or a cluster's workers."""
    if cluster is None:
        return in_order

    def each(work: Sequence[TrialWork], make: Make, done: Done) -> None:
        each_trial(store, f"samples to {split}", work, make, done, cluster, processes=False)

    return each
