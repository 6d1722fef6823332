"""The whole chain: collect every protocol, synchronise, label, check the labels, train, evaluate,
judge a campaign that chooses nothing, search if that is asked for, report. Run again it goes on
where it was, and a step with nothing to do says so.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sliplab.analysis.campaigns import collected
from sliplab.flows.collect import collect
from sliplab.flows.labelling import label_check
from sliplab.flows.labelling.label import label
from sliplab.flows.labelling.label_check import check_labels
from sliplab.flows.labelling.label_errors import CHECK
from sliplab.flows.learning.evaluate import evaluate
from sliplab.flows.learning.train import train
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.reporting.report import report
from sliplab.flows.searching.holdout import STEP, measure_holdout
from sliplab.flows.study_ledger import Ledger, Row
from sliplab.flows.study_searches import Search, training_windows
from sliplab.flows.syncing.sync import sync
from sliplab.storage.trials.store import Store

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
    run_requests: list[RunRequest], check: int = 0, more: Sequence[Search] = (), holdout: int = 0
) -> Outcome:
    """Run what is missing or stale, step by step; a step with nothing to do says so.

    Args:
        check: trials whose labels are checked with video, where the rig draws none.
        more: what is searched before the report.
        holdout: trials of the campaign that chooses nothing, where slides are simulated.
    """
    Store.create(run_requests[0].store)
    check = check if label_check.wanted(run_requests[0]) else 0
    slides = [o for o in run_requests if o.plan.protocol.collection.experiment == "kinematic"]
    holdout = holdout if slides and slides[0].rig.simulated else 0
    ledger = Ledger(run_requests[0].store, expected(run_requests, check, more, holdout))
    done = []
    for run_request in run_requests:
        with ledger.step(f"collect {run_request.campaign}") as on_done:
            result = collect(run_request)
            done.append(result)
            _report_done(on_done, result["taken"], "trials taken")
    store = Store.open(run_requests[0].store)
    campaigns = collected(store, [run_request.campaign for run_request in run_requests])
    steps = []

    def run(name: str, work: Callable[[], dict[str, Any]], of: str) -> None:
        with ledger.step(name) as on_done:
            result = work()
            steps.append(result)
            _report_done(on_done, result["done"], of)

    run("sync", lambda: sync(store, campaigns), "trials")
    run("label", lambda: label(store, campaigns), "trials")
    if check:
        run(CHECK, lambda: check_labels(run_requests[0], check), "trials")
    run("train", lambda: train(store, campaigns), "networks")
    run("evaluate", lambda: evaluate(store, campaigns), "evaluations")
    if holdout:
        run(STEP, lambda: measure_holdout(store, campaigns, holdout), "evaluations")
    for search in more:
        run(search.name, partial(search.work, store, campaigns), search.of)
    run("report", lambda: report(store, campaigns), "pages")
    return Outcome(done, steps, ledger.rows())


def expected(
    run_requests: list[RunRequest], check: int, more: Sequence[Search] = (), holdout: int = 0
) -> dict[str, float]:
    """Seconds that each step is expected to take from nothing."""
    seconds: dict[str, float] = {}
    labelled, trials = 0.0, 0
    for run_request in run_requests:
        plan, source = run_request.plan, run_request.rig.frame_source
        count = len(plan.trials)
        trials += count
        labelled += LABEL_S[source] * count
        simulated = COLLECT_S[source] * count
        taken = simulated if run_request.rig.in_virtual_time else plan.total_seconds
        seconds[f"collect {run_request.campaign}"] = taken
    seconds["sync"], seconds["label"] = SYNC_S * trials, labelled
    if check:
        seconds[CHECK] = (COLLECT_S["video"] + LABEL_S["video"]) * check
    seconds["train"] = _training_s(run_requests)
    seconds["evaluate"] = EVALUATE_S * trials
    if holdout:
        source = run_requests[0].rig.frame_source
        seconds[STEP] = (COLLECT_S[source] + LABEL_S[source] + EVALUATE_S) * holdout
    seconds = {**seconds, **{search.name: search.seconds for search in more}, "report": 0.0}
    return {name: START_S + each for name, each in seconds.items()}


def _training_s(run_requests: list[RunRequest]) -> float:
    found = [
        run_request
        for run_request in run_requests
        if run_request.plan.protocol.collection.experiment == "kinematic"
    ]
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
