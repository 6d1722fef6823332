"""The whole chain: collect every protocol, synchronise, label, check the labels, train, evaluate,
evaluate a hold-out campaign, run searches on request, report. Run again it resumes
where it stopped, and a step with nothing to do says so.

Searches take hours and run on request only: other methods on the same windows, and those of
plug-ins. Each keeps what it made, and the report shows those that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from sliplab.analysis.campaigns import (
    Collected,
    collected,
)
from sliplab.analysis.evaluation.holdout import STEP
from sliplab.analysis.labels.label_errors import CHECK
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.problem import problem_of
from sliplab.analysis.study_plan import PlannedCampaign, Search, StudyPlan
from sliplab.flows.collect import CollectResult, collect
from sliplab.flows.evaluate import evaluate
from sliplab.flows.holdout import measure_holdout
from sliplab.flows.label import check_labels, check_required, label
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.report import report
from sliplab.flows.steps import StepDone
from sliplab.flows.study_ledger import Ledger, StudyStep
from sliplab.flows.sync import sync
from sliplab.flows.train import train
from sliplab.flows.window_checks import window_baselines
from sliplab.protocols.errors import InputError
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import import_foreign
from sliplab.storage.trials.store import TrialStore

BASELINE_S = 0.0105
"""Time of all ordinary networks and trees, per training window, s."""


@dataclass(frozen=True)
class StudyOutcome:
    """Results of every step of a study, and their times."""

    collected: list[CollectResult]
    steps: list[StepDone]
    rows: list[StudyStep]


def study(
    run_requests: list[RunRequest], check: int = 0, more: Sequence[Search] = (), holdout: int = 0
) -> StudyOutcome:
    """Run missing or stale steps in order; a step with nothing to do reports that.

    Args:
        check: trials whose labels are checked with video, where the rig draws none.
        more: searches before the report.
        holdout: trials of the campaign that chooses nothing, where slides are simulated.
    """
    store = TrialStore.create(run_requests[0].store)
    planned = study_plan(run_requests)
    one_camera = len(run_requests[0].rig.cameras) == 1
    check = check if check_required(run_requests[0]) and not one_camera else 0
    holdout = holdout if planned.slides and planned.slides[0].simulated else 0
    ledger = Ledger(store.folder, planned.expected(check, more, holdout))
    taken: list[CollectResult] = []
    steps: list[StepDone] = []
    for run_request in run_requests:
        with ledger.step(f"collect {run_request.campaign}", "trials taken") as on_done:
            taken.append(collect(run_request))
            on_done(taken[-1]["taken"])
    campaigns = collected(store, [run_request.campaign for run_request in run_requests])
    problem = problem_of(StoreLabels(store), campaigns)

    def run(name: str, unit: str, work: Callable[[], StepDone]) -> None:
        if (reason := problem.reason_against(name)) is not None:
            ledger.leave_out(name, reason)
            return
        with ledger.step(name, unit) as on_done:
            steps.append(work())
            on_done(steps[-1]["done"])

    run("sync", "trials", lambda: sync(store, campaigns))
    run("label", "trials", lambda: label(store, campaigns))
    if check:
        run(CHECK, "trials", lambda: check_labels(run_requests[0], check))
    run("train", "networks", lambda: train(store, campaigns))
    run("evaluate", "evaluations", lambda: evaluate(store, campaigns))
    if holdout:
        run(STEP, "evaluations", lambda: measure_holdout(store, campaigns, holdout))
    for each in more:
        run(each.name, each.unit, partial(_search, each, store, campaigns))
    run("report", "pages", lambda: report(store, campaigns))
    return StudyOutcome(taken, steps, ledger.rows())


def _search(search: Search, store: TrialStore, campaigns: list[Collected]) -> StepDone:
    return {"step": search.name, "done": search.run(store, campaigns)}


def study_plan(run_requests: Sequence[RunRequest]) -> StudyPlan:
    """Return the study that run requests are for."""
    return StudyPlan(
        [
            PlannedCampaign(
                each.campaign,
                each.plan,
                each.rig.frame_source,
                each.rig.simulated,
                each.rig.in_virtual_time,
            )
            for each in run_requests
        ]
    )


def searches(run_requests: Sequence[RunRequest]) -> list[Search]:
    """Return the searches that a study can have: the core's own, and those of plug-ins.

    Raises:
        InputError: none; there is no kinematic protocol and nothing is simulated.
        PluginError: one of a plug-in cannot be imported.
    """
    planned = study_plan(run_requests)
    found = [_baselines(planned)]
    places = plugins().declared("searches").values()
    found += [import_foreign(place)(planned, run_requests) for place in places]
    can = [search for search in found if search is not None]
    if not can:
        raise InputError("--searches", "", True, "needs a kinematic protocol, or a simulated rig")
    return can


def _baselines(planned: StudyPlan) -> Search | None:
    if not planned.slides:
        return None
    seconds = BASELINE_S * planned.training_windows
    return Search(
        "baselines",
        "methods",
        seconds,
        lambda store, campaigns: window_baselines(store, campaigns)["done"],
    )
