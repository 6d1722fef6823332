"""Evaluation of other networks on the test trials: the preset in `also`, and model files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from prefect import flow

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation import networks
from sliplab.analysis.evaluation.networks import CountedBy, Engines, Judgement, network_of
from sliplab.analysis.evaluation.trials import item_trials, quiet_alarms, summaries
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.problem import need_slip
from sliplab.analysis.trial_work import KeepTrials, Make, TrialWork
from sliplab.flows.label import report_states
from sliplab.flows.running.orchestration import run
from sliplab.flows.running.parallel_map import keep_trials
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.storage.schema.evaluation import (
    Accuracy,
    AlarmRate,
    LatencyByOnset,
    LeadFigures,
    OtherEvaluation,
    Share,
)
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

if TYPE_CHECKING:
    import pandas as pd

    from sliplab.flows.running.cluster import Cluster


def spike_keeper(store: TrialStore, cluster: Cluster | None) -> KeepTrials:
    """Return a function that counts and stores spikes: in this process, where it uses all cores,
    or on a cluster."""

    def keep(step: str, work: list[TrialWork], make: Make) -> None:
        keep_trials(store, step, "evaluate", work, make, cluster, processes=False)

    return keep


class NetworkScores(StepResult):
    """Scores of a model of a file.

    Attributes:
        model: the network as text.
        margin: of the rule, in spikes, by campaign.
        accuracy, interval: of the sample windows.
        false_alarms: an hour of quiet holding; None without slides.
        latency_ms: of the slides; lead_ms: of the other experiments, by name.
    """

    model: str
    engine: CountedBy
    simulated: bool
    margin: dict[str, float]
    accuracy: Accuracy
    interval: Share
    false_alarms: AlarmRate | None
    latency_ms: LatencyByOnset
    lead_ms: dict[str, LeadFigures]


def judge_model(
    store: TrialStore,
    campaigns: list[Collected],
    model: Path,
    engine: Engines | None = None,
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> NetworkScores:
    """Judge a model of a file on the test trials; return figures for people and programs.

    Args:
        model, engine: see `analysis.evaluation.networks.network_of`.
        margin, smoothing: instead of the protocols' own.
        reviewed: people's decisions are applied to the labels.

    Raises:
        InputError: the model; the message says what would be right.
        StoreError: a trial has no label yet.
    """
    labels = StoreLabels(store, reviewed)
    need_slip(labels, campaigns)
    network = network_of(model, engine)
    judgement = networks.file_judgement(labels, campaigns, network, margin, smoothing)
    return _scores(judgement, cluster)


def judge_predictions(
    store: TrialStore,
    campaigns: list[Collected],
    predictions: Path | pd.DataFrame,
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> NetworkScores:
    """Judge any model by its predictions for the test windows, as `judge_model` judges one.

    Args:
        predictions: their table or its file; see `analysis.evaluation.predictions`.

    Raises:
        InputError: the table; all its faults at once.
        StoreError: a trial has no label yet.
    """
    from sliplab.analysis.evaluation.predictions import prediction_judgement

    labels = StoreLabels(store, reviewed)
    need_slip(labels, campaigns)
    return _scores(prediction_judgement(labels, campaigns, predictions, margin, smoothing), cluster)


def _scores(judgement: Judgement, cluster: Cluster | None) -> NetworkScores:
    """Judge a network, and return its stored figures."""
    done = judge(judgement, cluster)
    store, campaigns, network = judgement.store, judgement.campaigns, judgement.network
    found = Derived.of(store, networks.STEP).load(network.name, OtherEvaluation)
    experiments = summaries(found.trials)
    kinematic = experiments["kinematic"]
    return {
        "step": "evaluate",
        "done": int(done),
        "fresh": int(not done),
        "model": network.title,
        "engine": network.engine,
        "simulated": store.simulated,
        "margin": {name: rule.margin for name, rule in judgement.rules.items()},
        "accuracy": found.windows.accuracy,
        "interval": found.windows.interval,
        "false_alarms": quiet_alarms(item_trials(campaigns, found.trials)),
        "latency_ms": kinematic.latency_ms,
        "lead_ms": {
            name: scores.lead_ms for name, scores in experiments.items() if name != "kinematic"
        },
        **report_states(judgement.labels, campaigns),
    }


def judge(judgement: Judgement, cluster: Cluster | None) -> bool:
    """Judge a network if anything changed; return True if it did."""
    stale = not judgement.fresh
    if stale:
        run(judge_flow, judgement, cluster, cluster=cluster)
    return stale


@flow(name="judge a network", validate_parameters=False, persist_result=False)
def judge_flow(judgement: Judgement, cluster: Cluster | None) -> None:
    """Count the network's spikes in every test trial, then evaluate it."""
    with timed(judgement.store, "evaluate"):
        judgement.count(spike_keeper(judgement.store, cluster), None if cluster is None else 1)
        networks.score_network(judgement)
