"""Evaluation of the trained network on test trials."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, NotRequired, TypedDict

import numpy as np
from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation.evaluation import STEP, EvaluationJob
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import training_settings
from sliplab.analysis.problem import Job, Problem, Workers, problem_of
from sliplab.analysis.report.scores import FILE
from sliplab.flows.judge_network import judge, spike_keeper
from sliplab.flows.label import report_states
from sliplab.flows.report import write_scores
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.train import sample_maker
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


class PromisedDetector(TypedDict):
    """A compared detector at the level that promises a rate of false alarms.

    Attributes:
        level: of the incipient evidence; None: infinite.
        says: what the level promises, or why the recorded time cannot promise it.
        validation, test: an `AlarmRate` on trials until their onset; None without trials.
        median_ms: incipient latency on test trials, a missed one infinite; None if so.
    """

    detector: str
    simulated: bool
    level: float | None
    promised: bool
    says: str
    validation: Json
    test: Json | None
    median_ms: float | None


class EvaluateDone(StepResult):
    """Numbers of what `evaluate` did."""

    promise: NotRequired[list[PromisedDetector]]


def evaluate(
    store: TrialStore,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
    promise: float | None = None,
) -> EvaluateDone:
    """Evaluate if any input or setting changed; also the network that `analysis.also` names.

    The numbers are written as a table of scores, too.

    Args:
        margin, smoothing: instead of the protocols' own, and of what these would choose.
        cluster: what counts spikes and makes samples, instead of this machine.
        reviewed: people's decisions are applied to the labels.
        promise: also return the compared detectors at levels that promise at most so many false
            alarms an hour; what is stored stays the same.

    Raises:
        InputError: a promise is asked, and no detectors are compared.
    """
    labels = StoreLabels(store, reviewed)
    problem = problem_of(labels, campaigns)
    job = problem.job(margin, smoothing)
    compared = isinstance(job, EvaluationJob) and job.detectors.compared is not None
    if promise is not None and not compared:
        right = "needs detectors of slip by events, which `analysis.detection.compare` compares"
        raise InputError("--promise", "", promise, right)
    stale = not Derived.of(store, STEP).fresh(problem.name, job.key)
    if stale:
        run(evaluate_flow, problem, job, cluster, cluster=cluster)
    for other in problem.others():
        stale |= judge(other, cluster)
    folder = Derived.of(store, STEP).folder
    if stale or not (folder / FILE).exists():
        write_scores(problem, problem.numbers(), folder)
    done: EvaluateDone = {"step": "evaluate", "done": int(stale), "fresh": int(not stale)}
    states = report_states(labels, campaigns)
    if "reviewed" in states:
        done["reviewed"] = states["reviewed"]
    if promise is not None:
        assert isinstance(job, EvaluationJob)
        done["promise"] = _promises(job, promise)
    return done


def _promises(job: EvaluationJob, promise: float) -> list[PromisedDetector]:
    rule = job.detection[training_campaigns(job.campaigns)[0].name]
    settings = training_settings(job.campaigns)
    rows = []
    for row in job.detectors.promise(job.store, settings, rule, promise):
        level = row.level
        rows.append(
            PromisedDetector(
                detector=row.rule.name,
                simulated=job.store.simulated,
                level=level.value if np.isfinite(level.value) else None,
                promised=level.promised,
                says=level.words,
                validation=level.found.to_json(),
                test=None if row.test is None else row.test.to_json(),
                median_ms=row.median_ms,
            )
        )
    return rows


@flow(name="evaluate", validate_parameters=False, persist_result=False)
def evaluate_flow(problem: Problem, job: Job, cluster: Cluster | None) -> None:
    """Make what is missing of the trials, then evaluate the network."""
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
