"""Training: the network of every seed, from the labelled trials of the kinematic campaigns.

What is learned depends on what the campaigns show (`analysis.problem`).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.problem import Problem, problem_of
from sliplab.analysis.trial_work import Done, EachTrial, Make, TrialWork, in_order
from sliplab.flows.label import report_states
from sliplab.flows.running import console
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.parallel_map import each_trial
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.ui.train_view import training_progress
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


@task(name="train one seed", cache_policy=NO_CACHE, persist_result=False)
def train_one(job: Opaque[tuple[Problem, ModelOnDisk, Any, Any, bool]]) -> int:
    """Train and store one network."""
    problem, model, train, validation, simulated = job.content
    for line in problem.train(
        model, train, validation, partial(training_progress, simulated=simulated)
    ):
        console.say(line)
    return model.seed


@flow(name="train", validate_parameters=False, persist_result=False)
def train_flow(problem: Problem, models: list[ModelOnDisk], cluster: Cluster | None) -> int:
    """Train the missing and stale seeds one after another."""
    store = problem.labels.store
    simulated = any(r.simulated for item in problem.campaigns for _, r in item.trials[:1])
    with timed(store, "train"):
        train, validation = (
            problem.samples(split, sample_maker(store, split, cluster))
            for split in ("train", "validation")
        )
        _warn_of_missing(models[0].classes, train)
        for model in models:
            train_model = train_one.with_options(task_run_name=f"train {model.title}")
            train_model(Opaque((problem, model, train, validation, simulated)))
    return len(models)


def train(
    store: TrialStore,
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
    labels = StoreLabels(store, reviewed)
    problem = problem_of(labels, campaigns)
    models = problem.models()
    stale = [model for model in models if not model.fresh]
    if stale:
        problem.check()
        run(train_flow, problem, stale, cluster, cluster=cluster)
    return {
        "step": "train",
        "done": len(stale),
        "fresh": len(models) - len(stale),
        **report_states(labels, campaigns),
    }


def _warn_of_missing(classes: tuple[str, ...], train: Any) -> None:
    """Warn of classes that a network cannot learn."""
    there = set(np.unique(train.y).tolist())
    missing = [name for number, name in enumerate(classes) if number not in there]
    if missing:
        console.say(
            f"warning: no training samples of {', '.join(missing)}: the network cannot learn "
            + ("it" if len(missing) == 1 else "them")
        )


def sample_maker(store: TrialStore, split: str, cluster: Cluster | None) -> EachTrial:
    """Return what makes the samples of a split: this process, or a cluster's workers."""
    if cluster is None:
        return in_order

    def each(work: Sequence[TrialWork], make: Make, done: Done) -> None:
        each_trial(store, f"samples to {split}", work, make, done, cluster, processes=False)

    return each
