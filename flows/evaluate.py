"""Evaluation of the trained network on test trials."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.evaluation import STEP
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.problem import Job, Problem, Workers, problem_of
from sliplab.analysis.report.scores import FILE
from sliplab.flows.judge_network import judge, spike_keeper
from sliplab.flows.label import report_states
from sliplab.flows.report import write_scores
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.train import sample_maker
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


def evaluate(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> StepResult:
    """Evaluate if any input or setting changed; also the network that `analysis.also` names.

    The numbers are written as a table of scores, too.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        cluster: what counts spikes and makes samples, instead of this machine.
        reviewed: people's decisions are applied to the labels.
    """
    labels = StoreLabels(store, reviewed)
    problem = problem_of(labels, campaigns)
    job = problem.job(margin, smoothing)
    stale = not Derived.of(store, STEP).fresh(problem.name, job.key)
    if stale:
        run(evaluate_flow, Opaque((problem, job, cluster)), cluster)
    for other in problem.others():
        stale |= judge(other, cluster)
    folder = Derived.of(store, STEP).folder
    if stale or not (folder / FILE).exists():
        write_scores(problem, problem.numbers(), folder)
    return {
        "step": "evaluate",
        "done": int(stale),
        "fresh": int(not stale),
        **report_states(labels, campaigns),
    }


@flow(name="evaluate", validate_parameters=False, persist_result=False)
def evaluate_flow(argument: Opaque[tuple[Problem, Job, Cluster | None]]) -> None:
    """Make what is missing of the trials, then evaluate the network."""
    problem, job, cluster = argument.content
    store = problem.labels.store
    threads = None if cluster is None else 1
    workers = Workers(
        partial(sample_maker, store, cluster=cluster), spike_keeper(store, cluster), threads
    )
    with timed(store, "evaluate"):
        score(Opaque((problem, job, problem.prepare(job, workers))))


@task(name="scores", cache_policy=NO_CACHE, persist_result=False)
def score(argument: Opaque[tuple[Problem, Job, Mapping[str, Any]]]) -> None:
    """Evaluate, and store one result."""
    problem, job, parts = argument.content
    problem.evaluate(job, parts)
