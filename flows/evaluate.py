"""Evaluation of the trained network and its baselines on trials it has never seen.

Beside it are other networks, other methods on the same windows, and checks that try to show that a
figure cannot be trusted.
"""

from __future__ import annotations

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.detectors.predictions import count_spikes, predict_trials
from sliplab.analysis.evaluation import baselines, evaluation, networks
from sliplab.analysis.evaluation.evaluation import Job, make_job, score_store
from sliplab.analysis.evaluation.networks import Engines, Judgement, OtherNetwork, network_of
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import (
    choose_model,
    comparison_models,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.analysis.networks.window_checks import (
    CheckFailed,
    check_chance,
    check_permutations,
    permuted,
    shuffled_chance,
)
from sliplab.analysis.trial_work import KeepTrials, Make, TrialWork
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.label import report_states
from sliplab.flows.running import console
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.parallel_map import keep_trials
from sliplab.flows.running.run_records import timed
from sliplab.flows.train import sample_maker
from sliplab.protocols.settings import Detection
from sliplab.storage.schema.evaluation import BaselineResult, OtherEvaluation
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store, StoreError

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

SPLITS = ("train", "validation", "test")
CHECKED_EPOCHS = 3
"""Epochs of each training on shuffled labels: enough to beat chance clearly with true labels."""
CHECKED_WINDOWS = 2000
"""Number of test windows that are checked, evenly spread over all."""


def _keeper(store: Store, cluster: Cluster | None) -> KeepTrials:
    """Return a function that counts and stores spikes: in this process, where it uses all cores,
    or on a cluster."""

    def keep(step: str, work: list[TrialWork], make: Make) -> None:
        keep_trials(store, step, "evaluate", work, make, cluster, processes=False)

    return keep


def evaluate(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> dict[str, Any]:
    """Evaluate if any input or setting changed; also the network that `analysis.also` names.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        cluster: what counts spikes and makes samples, instead of this machine.
        reviewed: people's decisions are applied to the labels.
    """
    training_campaigns(campaigns)
    job = make_job(store, campaigns, margin, smoothing, reviewed)
    stale = not Derived.of(store, evaluation.STEP).fresh(evaluation.NAME, job.key)
    if stale:
        run(evaluate_flow, Opaque((job, cluster)), cluster)
    stale |= evaluate_comparison(store, campaigns, cluster, reviewed)
    return {
        "step": "evaluate",
        "done": int(stale),
        "fresh": int(not stale),
        **report_states(job.labels, campaigns),
    }


@flow(name="evaluate", validate_parameters=False, persist_result=False)
def evaluate_flow(argument: Opaque[tuple[Job, Cluster | None]]) -> None:
    """Count spikes where needed, then score."""
    job, cluster = argument.content
    keep, threads = _keeper(job.store, cluster), None if cluster is None else 1
    windows = training_settings(job.campaigns).windows
    with timed(job.store, "evaluate"):
        trials = [(item.name, recording, key) for item, _, recording, key in job.trials]
        count_spikes(job.store, job.model.path, windows, trials, keep, threads)
        predict_trials(job.store, job.model.path, windows, job.detectors.requests, keep, threads)
        train, test = (
            load_samples(job.labels, job.campaigns, split, sample_maker(job.store, split, cluster))
            for split in ("train", "test")
        )
        score(Opaque((job, train, test)))


@task(name="scores", cache_policy=NO_CACHE, persist_result=False)
def score(argument: Opaque[tuple[Job, SampleSet, SampleSet]]) -> None:
    """Windows, detections and label errors, kept as one result."""
    score_store(*argument.content)


def judge_model(
    store: Store,
    campaigns: list[Collected],
    model: Path,
    engine: Engines | None = None,
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> dict[str, Any]:
    """Judge a model of a file on the test trials; return figures for people and programs.

    Args:
        model, engine: see `analysis.evaluation.networks.network_of`.
        margin, smoothing: instead of the protocols' own.
        reviewed: people's decisions are applied to the labels.

    Raises:
        InputError: the model; the message says what would be right.
        StoreError: a trial has no label yet.
    """
    network = network_of(model, engine)
    change: dict[str, Any] = {"margin": margin, "smoothing": smoothing}
    change = {name: value for name, value in change.items() if value is not None}
    change |= {"choose": "protocol", "compare": None}
    rules = {
        name: Detection.model_validate({**rule.model_dump(), **change})
        for name, rule in rules_of(campaigns, network.outputs_per_class).items()
    }
    labels = Labels(store, reviewed)
    about = {"preset": None, "seed": None}
    judgement = Judgement(store, campaigns, labels, network, rules, about)
    if network.engine == "fast" and not network.exact:
        console.say(
            f"warning: {network.title}: its weights are off the grid, where the fast engine's "
            "counts may differ from Sinabs' in a few windows; --engine sinabs gives Sinabs' own"
        )
    done = _judge(judgement, cluster)
    found = Derived.of(store, networks.STEP).load(network.name, OtherEvaluation)
    kinematic = found.experiments["kinematic"]
    return {
        "step": "evaluate",
        "done": int(done),
        "fresh": int(not done),
        "model": network.title,
        "engine": network.engine,
        "same_as_sinabs": network.exact or network.engine == "sinabs",
        "simulated": store.simulated,
        "margin": {name: rule.margin for name, rule in rules.items()},
        "accuracy": found.windows.accuracy.to_json(),
        "interval": found.windows.interval.to_json(),
        "latency_ms": kinematic.latency_ms.to_json(),
        "lead_ms": {
            name: scores.lead_ms.to_json()
            for name, scores in found.experiments.items()
            if name != "kinematic"
        },
        **report_states(labels, campaigns),
    }


def evaluate_comparison(
    store: Store,
    campaigns: list[Collected],
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> bool:
    """Judge the network that `analysis.also` asks for; return True if there was anything to do.

    Raises:
        StoreError: it is missing or stale.
    """
    done = False
    for model in comparison_models(store, campaigns, reviewed):
        if not model.fresh:
            raise StoreError(f"{model.path}: is missing or stale; run `sliplab train` first")
        settings = model.settings
        own = settings.network.outputs_per_class
        network = OtherNetwork(
            f"preset-{settings.preset}", f"preset: {settings.preset}", model.path.read_bytes(),
            None, settings.windows, own, "fast", exact=True,
        )  # fmt: skip
        rules = {
            item.name: settings.detection.model_copy(
                update={"false_early_ms": item.settings.detection.false_early_ms}
            )
            for item in campaigns
        }
        about = {"preset": settings.preset, "seed": model.seed}
        labels = Labels(store, reviewed)
        done |= _judge(Judgement(store, campaigns, labels, network, rules, about), cluster)
    return done


def _judge(judgement: Judgement, cluster: Cluster | None) -> bool:
    """Judge a network if anything changed; return True if it did."""
    stale = not judgement.fresh
    if stale:
        run(judge_flow, Opaque((judgement, cluster)), cluster)
    return stale


@flow(name="judge a network", validate_parameters=False, persist_result=False)
def judge_flow(argument: Opaque[tuple[Judgement, Cluster | None]]) -> None:
    """Count spikes of every test trial, then score."""
    judgement, cluster = argument.content
    with timed(judgement.store, "evaluate"):
        judgement.count(_keeper(judgement.store, cluster), None if cluster is None else 1)
        networks.score_network(judgement)


def window_baselines(
    store: Store, campaigns: list[Collected], reviewed: bool = False
) -> dict[str, Any]:
    """Train and keep every baseline that is missing or stale.

    Args:
        reviewed: people's decisions are applied to the labels.
    """
    load = partial(load_samples, Labels(store, reviewed), campaigns)
    train, validation, test = map(load, SPLITS)
    kept = Derived.of(store, baselines.STEP)
    keys = {name: baselines.baseline_key(store, name) for name in baselines.NAMES}
    stale = [name for name, key in keys.items() if not kept.fresh(name, key)]
    if stale:
        with timed(store, "baselines"):
            for name in stale:
                console.say(f"{name}: {len(train)} training windows")
                votes, made = baselines.train_baseline(name, train, validation, test, console.say)
                result = BaselineResult(made=made, argmax=metrics.accuracy(votes, test.y).argmax)
                kept.write(name, keys[name], result, {"votes": votes})
    return {
        "step": "baselines",
        "done": len(stale),
        "fresh": len(keys) - len(stale),
        "argmax": {name: kept.load(name, BaselineResult).argmax for name in keys},
    }


def window_checks(
    store: Store, campaigns: list[Collected], reviewed: bool = False
) -> dict[str, Any]:
    """Check permuted classes, shuffled labels, and that no trial is in two parts of the split.

    Raises:
        StoreError: a check failed; the message says which figure cannot be trusted.
    """
    settings = training_settings(campaigns)
    load = partial(load_samples, Labels(store, reviewed), campaigns)
    train, validation, test = map(load, SPLITS)
    if not len(test):
        raise StoreError("there are no test samples to check; collect more trials")
    model = choose_model(wanted_models(store, campaigns, reviewed))
    rows = np.unique(
        np.linspace(0, len(test) - 1, min(CHECKED_WINDOWS, len(test))).astype(np.int64)
    )
    few = test.windows.take(rows)
    change = {"epochs": CHECKED_EPOCHS, "patience": CHECKED_EPOCHS}
    how = settings.training.model_copy(update=change)
    try:
        console.say("permuted classes")
        orders = check_permutations(
            permuted(model_file.load(model.path), few), test.y[rows], metrics.score
        )
        console.say("shuffled labels (nine short trainings)")
        chance = shuffled_chance(
            (train.windows, train.y), (validation.windows, validation.y), (few, test.y[rows]),
            settings.network, settings.windows, how,
        )  # fmt: skip
        check_chance(chance)
    except (CheckFailed, ValueError) as error:
        raise StoreError(f"{store.folder}: {error}") from None
    return {"step": "checks", "done": 2, "fresh": 0, "orders": orders, "shuffled": asdict(chance)}
