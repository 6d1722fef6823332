"""The whole chain: collect every protocol, synchronise, label, check the labels, train, evaluate,
evaluate a hold-out campaign, run searches on request, report. Run again it resumes
where it stopped, and a step with nothing to do says so.

The searches take hours and run on request only: other methods on the same windows, other skins
and levels left out, the sensitivity to the scene's assumed numbers, and speed against error of the
scene and of the detector. Each keeps what it made, and the report shows those that are there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from sliplab.analysis.campaigns import Collected, collected, training_campaigns
from sliplab.analysis.labels.label_errors import CHECK
from sliplab.analysis.report.programs import FILES
from sliplab.analysis.sweeps.detector_grid import Axes
from sliplab.analysis.sweeps.detector_search import SearchSize
from sliplab.analysis.sweeps.holdout import STEP
from sliplab.analysis.sweeps.sensitivity import value_of
from sliplab.flows.collect import collect
from sliplab.flows.evaluate import evaluate
from sliplab.flows.generalise import SKINS, measure_generalisation
from sliplab.flows.guesses import GUESSES, TRIALS, measure_guesses
from sliplab.flows.holdout import measure_holdout
from sliplab.flows.label import check_labels, check_required, label
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.report import report
from sliplab.flows.study_ledger import Ledger, Row
from sliplab.flows.sync import sync
from sliplab.flows.tradeoff_detector import tradeoff_detector
from sliplab.flows.tradeoff_scene import tradeoff_scene
from sliplab.flows.train import train
from sliplab.flows.window_checks import window_baselines
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

SCENE_TRIALS = 4
SIZE, AXES = SearchSize(), Axes()

COLLECT_S = {"tracks": 0.3, "video": 5.0}
"""Expected seconds of a simulated trial on two cores, by the camera's source; a real one takes what
is planned. Likewise:"""
LABEL_S = {"tracks": 0.2, "video": 1.5}
SYNC_S = 0.03
SAMPLES_PER_S = 1500.0
EVALUATE_S = 0.045
START_S = 4.0
"""Fixed time of a step: processes, kernels, pages."""
BASELINE_S = 0.0105
"""Time of all ordinary networks and trees, per training window."""
LEVEL_S = 0.0004
"""Time of a level that is left out, per window and epoch."""
SKIN_S, GUESS_S, SCENE_S, SEARCH_S = 25.0, 40.0, 120.0, 6000.0

Json = dict[str, Any]


@dataclass(frozen=True)
class Search:
    """A search that a study does before its report.

    Attributes:
        name: of the step.
        unit: noun in plural that its work is counted in.
        seconds: expected from nothing.
        work: does what is missing; ``done`` of its result counts it.
    """

    name: str
    unit: str
    seconds: float
    work: Callable[[Store, list[Collected]], Json]


@dataclass(frozen=True)
class Outcome:
    """Results of every step of a study, and their times."""

    collected: list[Json]
    steps: list[Json]
    rows: list[Row] = field(default_factory=list)


def study(
    run_requests: list[RunRequest], check: int = 0, more: Sequence[Search] = (), holdout: int = 0
) -> Outcome:
    """Run what is missing or stale, step by step; a step with nothing to do says so.

    Args:
        check: trials whose labels are checked with video, where the rig draws none.
        more: searches before the report.
        holdout: trials of the campaign that chooses nothing, where slides are simulated.
    """
    Store.create(run_requests[0].store)
    check = check if check_required(run_requests[0]) else 0
    slides = _slides(run_requests)
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

    def run(name: str, work: Callable[[], Json], unit: str) -> None:
        with ledger.step(name) as on_done:
            result = work()
            steps.append(result)
            _report_done(on_done, result["done"], unit)

    run("sync", lambda: sync(store, campaigns), "trials")
    run("label", lambda: label(store, campaigns), "trials")
    if check:
        run(CHECK, lambda: check_labels(run_requests[0], check), "trials")
    run("train", lambda: train(store, campaigns), "networks")
    run("evaluate", lambda: evaluate(store, campaigns), "evaluations")
    if holdout:
        run(STEP, lambda: measure_holdout(store, campaigns, holdout).to_json(), "evaluations")
    for search in more:
        run(search.name, partial(search.work, store, campaigns), search.unit)
    run("report", lambda: report(store, campaigns), "pages")
    return Outcome(done, steps, ledger.rows())


def _report_done(on_done: Callable[[str, bool], None], done: int, unit: str) -> None:
    if done == 1:
        unit = unit.replace("s", "", 1)  # the one of the noun
    on_done(f"{done} {unit}" if done else "nothing to do", bool(done))


def _slides(run_requests: Sequence[RunRequest]) -> list[RunRequest]:
    return [
        run_request
        for run_request in run_requests
        if run_request.plan.protocol.collection.experiment == "kinematic"
    ]


def expected(
    run_requests: list[RunRequest], check: int, more: Sequence[Search] = (), holdout: int = 0
) -> dict[str, float]:
    """Return the seconds that each step is expected to take from nothing."""
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
    seconds["train"] = _training_s(_slides(run_requests))
    seconds["evaluate"] = EVALUATE_S * trials
    if holdout:
        source = run_requests[0].rig.frame_source
        seconds[STEP] = (COLLECT_S[source] + LABEL_S[source] + EVALUATE_S) * holdout
    seconds = {**seconds, **{search.name: search.seconds for search in more}, "report": 0.0}
    return {name: START_S + each for name, each in seconds.items()}


def _training_s(slides: list[RunRequest]) -> float:
    if not slides:
        return 0.0
    settings = slides[0].plan.protocol.analysis
    training = settings.training
    networks = len(training.seeds) + (settings.comparison_settings() is not None)
    return training_windows(slides) * training.epochs * networks / SAMPLES_PER_S


def training_windows(slides: list[RunRequest]) -> int:
    """Return how many windows a network learns from, as planned."""
    return sum(
        3 * run_request.plan.protocol.analysis.samples.per_class
        for run_request in slides
        for trial in run_request.plan
        if trial.split == "train"
    )


def searches(run_requests: list[RunRequest]) -> list[Search]:
    """Return the searches that a study can have: most need slides, and two a simulated scene.

    Raises:
        InputError: none; there is no kinematic protocol and nothing is simulated.
    """
    slides = _slides(run_requests)
    simulated = all(run_request.rig.simulated for run_request in run_requests)
    found = []
    if slides:
        windows = training_windows(slides)
        found.append(Search("baselines", "methods", BASELINE_S * windows, window_baselines))
        protocol = slides[0].plan.protocol
        epochs, factors = protocol.analysis.training.epochs, len(protocol.collection.all_factors)
        seconds = LEVEL_S * windows * epochs * factors + SKIN_S * SKINS
        found.append(Search("generalisation", "results", seconds, _generalisation))
    if simulated:
        names = tuple(
            name for name in GUESSES if all(value_of(o.rig.scene, name) for o in run_requests)
        )
        work = partial(_guesses, names=names)
        found.append(Search("guesses", "settings", GUESS_S * (1 + 2 * len(names)), work))
    if slides and simulated:
        found.append(Search("scene search", "searches", SCENE_S, _scene))
    if slides:
        found.append(Search("detector search", "trainings", SEARCH_S, _detector))
    if not found:
        raise InputError(
            "--searches", "", True, "needs a kinematic protocol, or a simulated rig with guesses"
        )
    return found


def _generalisation(store: Store, campaigns: list[Collected]) -> Json:
    result = measure_generalisation(store, campaigns)
    return {"step": "generalisation", "done": result.made}


def _guesses(store: Store, campaigns: list[Collected], names: tuple[str, ...]) -> Json:
    result = measure_guesses(store, campaigns, names, TRIALS)
    return {"step": "guesses", "done": result.measured}


def _scene(store: Store, campaigns: list[Collected]) -> Json:
    """Measure the scene of the first campaign of slides, unless that was done as it is."""
    item = training_campaigns(campaigns)[0]
    path, kept = store.folder / FILES["scene"], Derived.of(store, "scene-search")
    made_of = [item.plan.collection_hash, item.info["rig_hash"]]
    key = make_key("scene search", 1, made_of, SCENE_TRIALS)
    done = 0
    if not (path.exists() and kept.fresh("scene", key)):
        rig = item.campaign.folder / "rig.yaml"
        tradeoff_scene(item.campaign.protocol_file, rig, path.parent, SCENE_TRIALS)
        kept.write("scene", key, {"file": FILES["scene"]})
        done = 1
    return {"step": "scene search", "done": done}


def _detector(store: Store, campaigns: list[Collected]) -> Json:
    folder = (store.folder / FILES["detector"]).parent
    result = tradeoff_detector(store, campaigns, folder, SIZE, AXES)
    return {"step": "detector search", "done": result["made"]}
