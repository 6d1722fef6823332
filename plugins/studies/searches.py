"""Searches that `sliplab study --searches` runs: each done once, and shown in the report.

Seconds are expected from nothing, on two cores, where trials are simulated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.study import Finding, Study
from sliplab.analysis.study_plan import Search, StudyPlan
from sliplab.flows.planning.run_request import RunRequest
from sliplab.plugins.studies.detector.grid import Axes
from sliplab.plugins.studies.detector.run import tradeoff_detector
from sliplab.plugins.studies.detector.search import SearchSize
from sliplab.plugins.studies.detector.study import STUDY as TRADEOFF
from sliplab.plugins.studies.generalise.run import SKINS, measure_generalisation
from sliplab.plugins.studies.generalise.study import STUDY as GENERALISE
from sliplab.plugins.studies.section import RESULT

LEVEL_S = 0.0004
"""Time of a level that is left out, per window and epoch."""
SKIN_S, SEARCH_S = 25.0, 6000.0
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
        lambda store, campaigns: _written(GENERALISE, measure_generalisation(store, campaigns)),
    )


def detector(planned: StudyPlan, run_requests: Sequence[RunRequest]) -> Search | None:
    """Speed against error of the detector, where slides train a network."""
    if not planned.slides:
        return None
    return Search(
        "detector search",
        "trainings",
        SEARCH_S,
        lambda store, campaigns: _written(
            TRADEOFF,
            tradeoff_detector(store, campaigns, (store.folder / RESULT.file).parent, SIZE, AXES),
        ),
    )


def _written(study: Study[Any], found: Finding[Any]) -> int:
    """Write the files of a study; return how much was measured for it now."""
    study.write(found)
    return int(found.named["made"])
