"""Evaluation of the trained network on test trials."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import (
    Collected,
    missing_stream,
    of_classes,
    training_campaigns,
)
from sliplab.analysis.detectors.predictions import count_spikes, predict_trials, seed_step
from sliplab.analysis.evaluation import evaluation
from sliplab.analysis.evaluation.evaluation import EvaluationJob, make_job, score_store
from sliplab.analysis.networks.models import (
    training_settings,
)
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.flows.classes import evaluate_on_classes
from sliplab.flows.label import report_states
from sliplab.flows.markers import evaluate_on_markers
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.train import sample_maker
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster

from sliplab.flows.judge_network import evaluate_comparison, spike_keeper


def evaluate(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> StepResult:
    """Evaluate if any input or setting changed; also the network that `analysis.also` names.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        cluster: what counts spikes and makes samples, instead of this machine.
        reviewed: people's decisions are applied to the labels.
    """
    if of_classes(campaigns):
        return evaluate_on_classes(store, campaigns, margin, smoothing, cluster, reviewed)
    if missing_stream(campaigns) == "events":
        return evaluate_on_markers(store, campaigns, margin, smoothing, reviewed)
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
def evaluate_flow(argument: Opaque[tuple[EvaluationJob, Cluster | None]]) -> None:
    """Count missing spikes, then evaluate the network."""
    job, cluster = argument.content
    keep, threads = spike_keeper(job.store, cluster), None if cluster is None else 1
    windows = training_settings(job.campaigns).windows
    with timed(job.store, "evaluate"):
        trials = [(item.name, recording, key) for item, _, recording, key in job.trials]
        count_spikes(job.store, job.model.path, trials, keep, threads)
        for model, item in product(job.others, job.campaigns):
            count_spikes(
                job.store,
                model.path,
                job.counted_by(model, item),
                keep,
                threads,
                seed_step(model.seed),
                job.detection[item.name].stride_ms,
            )
        predict_trials(job.store, job.model.path, windows, job.detectors.requests, keep, threads)
        train, test = (
            load_samples(job.labels, job.campaigns, split, sample_maker(job.store, split, cluster))
            for split in ("train", "test")
        )
        score(Opaque((job, train, test)))


@task(name="scores", cache_policy=NO_CACHE, persist_result=False)
def score(argument: Opaque[tuple[EvaluationJob, SampleSet, SampleSet]]) -> None:
    """Evaluate windows, detections and label errors, and store one result."""
    score_store(*argument.content)
