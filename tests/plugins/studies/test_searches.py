"""Searches on top of a study: each done once, gone on with, and shown in the report."""

from __future__ import annotations

import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from sliplab.analysis.evaluation import baselines as window_baselines
from sliplab.flows.planning.run_request import RunRequest
from sliplab.flows.study import StudyOutcome, searches, study, study_plan
from sliplab.plugins.studies import searches as planned_searches
from sliplab.plugins.studies.detector.grid import Axes
from sliplab.plugins.studies.detector.search import SearchSize
from sliplab.plugins.studies.generalise.run import measure_generalisation
from sliplab.plugins.studies.generalise.section import RESULT as GENERALISATION
from sliplab.plugins.studies.section import RESULT
from sliplab.protocols.errors import InputError
from sliplab.storage.trials.store import TrialStore

pytestmark = pytest.mark.programs

NAMES = ["baselines", "generalisation", "detector search"]


def test_what_a_study_can_have(ran: tuple[list[RunRequest], StudyOutcome]) -> None:
    slides, falls = ran[0]
    assert [each.name for each in searches([slides, falls])] == NAMES
    real = slides.rig.model_copy(update={"driver": "devices"})
    assert not real.simulated
    slides, falls = (replace(run_request, rig=real) for run_request in (slides, falls))
    assert [each.name for each in searches([slides, falls])] == [
        "baselines",
        "generalisation",
        "detector search",
    ]
    with pytest.raises(InputError, match=r"--searches.*needs a kinematic protocol"):
        searches([falls])


def test_they_stand_before_the_report_with_their_own_time(
    ran: tuple[list[RunRequest], StudyOutcome],
) -> None:
    run_requests, _ = ran
    planned = study_plan(run_requests)
    plain, more = planned.expected(0), planned.expected(0, searches(run_requests))
    assert list(more)[-5:] == ["evaluate", *NAMES, "report"]
    assert sum(more.values()) - sum(plain.values()) > 3600


@pytest.mark.long
def test_each_is_done_once_and_reported(
    ran: tuple[list[RunRequest], StudyOutcome], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(ran[0][0].store, tmp_path / "store")
    run_requests = [replace(run_request, store=tmp_path / "store") for run_request in ran[0]]
    monkeypatch.setattr(window_baselines, "NAMES", {"logistic_cells": 1})
    few = partial(measure_generalisation, factors=("direction",), skins=1, trials=3, epochs=1)
    monkeypatch.setattr(planned_searches, "measure_generalisation", few)
    size = SearchSize(samples=40, epochs=1, trials=2, seeds=1, stride_ms=15)
    monkeypatch.setattr(planned_searches, "SIZE", size)
    axes = Axes(length_ms=(15, 30), step_ms=(1,), pool_px=(20,), width=(1.0,))
    monkeypatch.setattr(planned_searches, "AXES", axes)

    outcome = study(run_requests, more=searches(run_requests))
    done = {step["step"]: step["done"] for step in outcome.steps}
    assert done == {
        "sync": 0,
        "label": 0,
        "train": 0,
        "evaluate": 0,
        "baselines": 1,
        "generalisation": 2,
        "detector search": 2,
        "report": 1,
    }
    store = TrialStore.open(run_requests[0].store)
    for result in (GENERALISATION, RESULT):
        assert result.read(store) is not None
    page = (run_requests[0].store / "report" / "index.html").read_text()
    assert "The whole of the detector's search" in page

    again = study(run_requests, more=searches(run_requests))
    assert not any(step["done"] for step in again.steps)
    notes = {row.name: (row.state, row.note) for row in again.rows}
    assert all(notes[name] == ("done", "nothing to do") for name in NAMES)
