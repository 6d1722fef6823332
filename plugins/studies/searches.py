"""Searches that `sliplab study --searches` runs: each done once, and shown in the report.

Seconds are expected from nothing, on two cores, where trials are simulated.
"""

from __future__ import annotations

from collections.abc import Sequence

from sliplab.analysis.study_plan import Search, StudyPlan
from sliplab.flows.planning.run_request import RunRequest
from sliplab.plugins.studies.detector.grid import Axes
from sliplab.plugins.studies.detector.run import tradeoff_detector
from sliplab.plugins.studies.detector.search import SearchSize
from sliplab.plugins.studies.generalise.run import SKINS, measure_generalisation
from sliplab.plugins.studies.guesses.run import GUESSES, TRIALS, measure_guesses
from sliplab.plugins.studies.parameters import in_all
from sliplab.plugins.studies.results import RESULTS
from sliplab.plugins.studies.scene.run import search_scene

LEVEL_S = 0.0004
"""Time of a level that is left out, per window and epoch."""
SKIN_S, GUESS_S, SCENE_S, SEARCH_S = 25.0, 40.0, 120.0, 6000.0
SCENE_TRIALS = 4
SIZE, AXES = SearchSize(), Axes()


def generalisation(planned: StudyPlan, run_requests: Sequence[RunRequest]) -> Search | None:
    """Levels left out and other skins, where slides train a network."""
    if not planned.slides:
        return None
    protocol = planned.slides[0].plan.protocol
    epochs, factors = protocol.analysis.training.epochs, len(protocol.collection.all_factors)
    seconds = LEVEL_S * planned.training_windows * epochs * factors + SKIN_S * SKINS
    return Search(
        "generalisation",
        "results",
        seconds,
        lambda store, campaigns: measure_generalisation(store, campaigns).made,
    )


def guesses(planned: StudyPlan, run_requests: Sequence[RunRequest]) -> Search | None:
    """Assumed parameters of the scene lowered and raised, where it is simulated."""
    if not _simulated(planned):
        return None
    names = in_all(GUESSES, [each.rig.mock for each in run_requests])
    return Search(
        "guesses",
        "settings",
        GUESS_S * (1 + 2 * len(names)),
        lambda store, campaigns: measure_guesses(store, campaigns, names, TRIALS).measured,
    )


def scene(planned: StudyPlan, run_requests: Sequence[RunRequest]) -> Search | None:
    """Speed against error of the scene of slides, where it is simulated."""
    if not (planned.slides and _simulated(planned)):
        return None
    return Search(
        "scene search",
        "searches",
        SCENE_S,
        lambda store, campaigns: search_scene(store, campaigns, SCENE_TRIALS),
    )


def detector(planned: StudyPlan, run_requests: Sequence[RunRequest]) -> Search | None:
    """Speed against error of the detector, where slides train a network."""
    if not planned.slides:
        return None
    file = RESULTS["detector"].file
    return Search(
        "detector search",
        "trainings",
        SEARCH_S,
        lambda store, campaigns: tradeoff_detector(
            store, campaigns, (store.folder / file).parent, SIZE, AXES
        )["made"],
    )


def _simulated(planned: StudyPlan) -> bool:
    return all(item.simulated for item in planned.campaigns)
