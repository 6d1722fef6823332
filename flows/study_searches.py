"""What a study does on request between its evaluation and its report: searches that take hours.

Other methods on the same windows, other skins and levels left out, what the scene's guesses decide,
and speed against error of the scene and of the detector. Each keeps what it made, so that a study
that is stopped goes on with them, and the report shows those that are there.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.flows.learning.window_baselines import window_baselines
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.reporting.report_extras import FILES
from sliplab.flows.searching.detector_tradeoff import detector_tradeoff
from sliplab.flows.searching.detector_tradeoff_data import Ask
from sliplab.flows.searching.detector_tradeoff_grid import Axes
from sliplab.flows.searching.generalisation import SKINS, measure_generalisation
from sliplab.flows.searching.guesses import GUESSES, TRIALS, measure_guesses
from sliplab.flows.searching.sensitivity import value_of
from sliplab.flows.searching.tradeoff import tradeoff
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

SCENE_TRIALS = 4
ASK, AXES = Ask(), Axes()

BASELINE_S = 0.0105
"""What all ordinary networks and trees take for a training window, on two cores; likewise:"""
LEVEL_S = 0.0004
"""A level that is left out, for a window and an epoch."""
SKIN_S, GUESS_S, SCENE_S, SEARCH_S = 25.0, 40.0, 120.0, 6000.0


@dataclass(frozen=True)
class Search:
    """One of them.

    Attributes:
        name: of the step.
        of: what its work is counted in.
        seconds: that it is expected to take from nothing.
        work: does what is missing; ``done`` of its result says how much that was.
    """

    name: str
    of: str
    seconds: float
    work: Callable[[Store, list[Collected]], dict[str, Any]]


def searches(run_requests: list[RunRequest]) -> list[Search]:
    """Those that a study can have: most need slides, and two a simulated scene.

    Raises:
        InputError: none; there is no kinematic protocol and nothing is simulated.
    """
    slides = [o for o in run_requests if o.plan.protocol.collection.experiment == "kinematic"]
    simulated = all(run_request.rig.simulated for run_request in run_requests)
    found = []
    if slides:
        windows = training_windows(slides)
        found.append(Search("baselines", "methods", BASELINE_S * windows, _baselines))
        epochs = slides[0].plan.protocol.analysis.training.epochs
        factors = len(slides[0].plan.protocol.collection.factors)
        seconds = LEVEL_S * windows * epochs * factors + SKIN_S * SKINS
        found.append(Search("generalisation", "results", seconds, _generalisation))
    if simulated:
        names = tuple(
            name for name in GUESSES if all(_has(run_request, name) for run_request in run_requests)
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


def training_windows(slides: list[RunRequest]) -> int:
    """Windows that a network learns from, as planned."""
    return sum(
        3 * run_request.plan.protocol.analysis.samples.per_class
        for run_request in slides
        for trial in run_request.plan
        if trial.split == "train"
    )


def _has(run_request: RunRequest, name: str) -> bool:
    try:
        return bool(value_of(run_request.rig.scene, name))
    except (AttributeError, TypeError, ValueError):
        return False


def _baselines(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    return window_baselines(store, campaigns)


def _generalisation(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    result = measure_generalisation(store, campaigns)
    return {"step": "generalisation", "done": result["made"]}


def _guesses(store: Store, campaigns: list[Collected], names: tuple[str, ...]) -> dict[str, Any]:
    result = measure_guesses(store, campaigns, names, TRIALS)
    return {"step": "guesses", "done": result["measured"]}


def _scene(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """The scene of the first campaign of slides, unless it was measured as it is."""
    item = training_campaigns(campaigns)[0]
    path, kept = store.folder / FILES["scene"], Derived.of(store, "scene-search")
    made_of = [item.plan.collection_hash, item.info["rig_hash"]]
    key = make_key("scene search", 1, made_of, SCENE_TRIALS)
    if path.exists() and kept.fresh("scene", key):
        return {"step": "scene search", "done": 0}
    campaign = item.campaign
    rig = campaign.folder / "rig.yaml"
    tradeoff(campaign.protocol_file, rig, path.parent, SCENE_TRIALS)
    kept.write("scene", key, {"file": FILES["scene"]})
    return {"step": "scene search", "done": 1}


def _detector(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    result = detector_tradeoff(store, campaigns, (store.folder / FILES["detector"]).parent,
                               ASK, AXES)  # fmt: skip
    return {"step": "detector search", "done": result["made"]}
