"""Other networks on the store's test trials: the preset that `also` names, and models of files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation import networks
from sliplab.analysis.evaluation.networks import Engines, Judgement, OtherNetwork, network_of
from sliplab.analysis.labels.reviewed import Labels
from sliplab.analysis.networks.models import (
    comparison_models,
    rules_of,
)
from sliplab.analysis.trial_work import KeepTrials, Make, TrialWork
from sliplab.flows.label import report_states
from sliplab.flows.running import console
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.parallel_map import keep_trials
from sliplab.flows.running.run_records import timed
from sliplab.protocols.settings import Detection
from sliplab.storage.schema.evaluation import OtherEvaluation
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store, StoreError

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


def spike_keeper(store: Store, cluster: Cluster | None) -> KeepTrials:
    """Return a function that counts and stores spikes: in this process, where it uses all cores,
    or on a cluster."""

    def keep(step: str, work: list[TrialWork], make: Make) -> None:
        keep_trials(store, step, "evaluate", work, make, cluster, processes=False)

    return keep


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
        judgement.count(spike_keeper(judgement.store, cluster), None if cluster is None else 1)
        networks.score_network(judgement)
