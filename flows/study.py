"""The whole chain: collect every protocol, synchronise, label, check the labels, train, evaluate,
judge a campaign that chooses nothing, search if that is asked for, report. Run again it goes on
where it was, and a step with nothing to do says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sliplab.flows.collecting.collect import collect
from sliplab.flows.labelling import label_check
from sliplab.flows.labelling.label import label
from sliplab.flows.labelling.label_check import check_labels
from sliplab.flows.labelling.label_errors import CHECK
from sliplab.flows.learning.evaluate import evaluate
from sliplab.flows.learning.train import train
from sliplab.flows.planning.orders import Order
from sliplab.flows.reporting.report import report
from sliplab.flows.running.campaigns import collected
from sliplab.flows.searching.holdout import STEP, measure_holdout
from sliplab.flows.study_ledger import Ledger, Row
from sliplab.flows.study_searches import Search, training_windows
from sliplab.flows.syncing.sync import sync
from sliplab.storage.store import Store

COLLECT_S = {"tracks": 0.3, "video": 5.0}
"""What a simulated trial is expected to take on two cores, by what the camera hands over; a real
one takes what is planned."""
LABEL_S = {"tracks": 0.2, "video": 1.5}
SYNC_S = 0.03
SAMPLES_PER_S = 1500.0
EVALUATE_S = 0.045
START_S = 4.0
"""What a step takes however little there is to do: processes, kernels, pages."""


@dataclass(frozen=True)
class Outcome:
    """What every step of a study did, and what it cost."""

    collected: list[dict[str, Any]]
    steps: list[dict[str, Any]]
    rows: list[Row] = field(default_factory=list)


def study(
    orders: list[Order], check: int = 0, more: Sequence[Search] = (), holdout: int = 0
) -> Outcome:
    """Run what is missing or stale, step by step; a step with nothing to do says so.

    Args:
        check: trials whose labels are checked with video, where the rig draws none.
        more: what is searched before the report.
        holdout: trials of the campaign that chooses nothing, where slides are simulated.
    """
    Store.create(orders[0].store)
    check = check if label_check.wanted(orders[0]) else 0
    slides = [o for o in orders if o.plan.protocol.collection.experiment == "kinematic"]
    holdout = holdout if slides and slides[0].rig.simulated else 0
    ledger = Ledger(orders[0].store, expected(orders, check, more, holdout))
    done = []
    for order in orders:
        with ledger.step(f"collect {order.campaign}") as on_done:
            result = collect(order)
            done.append(result)
            _report_done(on_done, result["taken"], "trials taken")
    store = Store.open(orders[0].store)
    campaigns = collected(store, [order.campaign for order in orders])
    steps = []

    def run(name: str, work: Callable[[], dict[str, Any]], of: str) -> None:
        with ledger.step(name) as on_done:
            result = work()
            steps.append(result)
            _report_done(on_done, result["done"], of)

    run("sync", lambda: sync(store, campaigns), "trials")
    run("label", lambda: label(store, campaigns), "trials")
    if check:
        run(CHECK, lambda: check_labels(orders[0], check), "trials")
    run("train", lambda: train(store, campaigns), "networks")
    run("evaluate", lambda: evaluate(store, campaigns), "evaluations")
    if holdout:
        run(STEP, lambda: measure_holdout(store, campaigns, holdout), "evaluations")
    for search in more:
        run(search.name, partial(search.work, store, campaigns), search.of)
    run("report", lambda: report(store, campaigns), "pages")
    return Outcome(done, steps, ledger.rows())


def expected(
    orders: list[Order], check: int, more: Sequence[Search] = (), holdout: int = 0
) -> dict[str, float]:
    """Seconds that each step is expected to take from nothing."""
    seconds: dict[str, float] = {}
    labelled, trials = 0.0, 0
    for order in orders:
        plan, source = order.plan, order.rig.frame_source
        count = len(plan.trials)
        trials += count
        labelled += LABEL_S[source] * count
        simulated = COLLECT_S[source] * count
        taken = simulated if order.rig.in_virtual_time else plan.total_seconds
        seconds[f"collect {order.campaign}"] = taken
    seconds["sync"], seconds["label"] = SYNC_S * trials, labelled
    if check:
        seconds[CHECK] = (COLLECT_S["video"] + LABEL_S["video"]) * check
    seconds["train"] = _training_s(orders)
    seconds["evaluate"] = EVALUATE_S * trials
    if holdout:
        source = orders[0].rig.frame_source
        seconds[STEP] = (COLLECT_S[source] + LABEL_S[source] + EVALUATE_S) * holdout
    seconds = {**seconds, **{search.name: search.seconds for search in more}, "report": 0.0}
    return {name: START_S + each for name, each in seconds.items()}


def _training_s(orders: list[Order]) -> float:
    found = [order for order in orders if order.plan.protocol.collection.experiment == "kinematic"]
    if not found:
        return 0.0
    settings = found[0].plan.protocol.analysis
    training = settings.training
    networks = len(training.seeds) + (settings.comparison_settings() is not None)
    return training_windows(found) * training.epochs * networks / SAMPLES_PER_S


def _report_done(on_done: Callable[[str, bool], None], done: int, of: str) -> None:
    if done == 1:
        of = of.replace("s", "", 1)  # the one of the noun
    on_done(f"{done} {of}" if done else "nothing to do", bool(done))
