"""A study from Prefect's page is the study of the command line."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from sliplab.flows.planning.run_request import make_request
from sliplab.flows.study import StudyOutcome
from sliplab.flows.study_defaults import LABELS_CHECKED, study_protocols
from sliplab.plugins.web.server import deployments
from sliplab.plugins.web.server.schedules import ScheduledStudy
from tests.conftest import ROOT


def test_only_the_whole_study_has_the_extra_disturbance() -> None:
    assert [file.stem for file in study_protocols(False, True)] == [
        "kinematic",
        "gravity",
        "disturbance",
    ]
    assert list(study_protocols(False, True).values()) == [(), (), ("disturbance=125",)]
    assert list(study_protocols(False, False).values()) == [(), (), ()]
    assert {file.stem: on for file, on in study_protocols(True, True).items()} == {
        "pilot": (),
        "pilot_gravity": (),
    }


@pytest.mark.parametrize(("extra", "trials"), [(True, 100), (False, 80)])
def test_a_served_study_asks_for_the_same_trials(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extra: bool, trials: int
) -> None:
    asked: list[Any] = []

    def study(run_requests: list[Any], check: int) -> StudyOutcome:
        asked.extend([run_requests, check])
        return StudyOutcome([{"taken": 3}], [{"step": "report", "done": 1}], [])

    monkeypatch.setattr("sliplab.flows.study.study", study)
    monkeypatch.setattr(
        deployments, "when_free", lambda _run_request, _patience, work, _run: work()
    )
    here: Any = SimpleNamespace(
        rig=ROOT / "rigs" / "rehearsal.yaml", folder=tmp_path / "store", since=None
    )
    said = deployments._study(ScheduledStudy(extra=extra), here, None)
    assert said == "3 trials taken; report: 1 done"
    run_requests, check = asked
    assert check == LABELS_CHECKED
    assert [len(run_request.plan.trials) for run_request in run_requests] == [864, 180, trials]
    for run_request, (file, on) in zip(
        run_requests, study_protocols(False, extra).items(), strict=True
    ):
        rig = ROOT / "rigs" / "rehearsal.yaml"
        assert run_request.plan == make_request(file, rig, tmp_path / "other", enable=on).plan
