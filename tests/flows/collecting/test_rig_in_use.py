"""Every command that drives a real rig asks for it first; who is refused opens no device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from sliplab.flows.calibrating.measurement import CalibrationSession, Measurement, MeasurementResult
from sliplab.flows.cli.rigs import _about
from sliplab.flows.collecting.session import open_session
from sliplab.flows.planning.preflight import check_devices
from sliplab.flows.planning.run_request import RunRequest
from sliplab.protocols import load_plan
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.rig_lock import ENVIRONMENT, lock_names
from sliplab.storage.trials.lock import Locked, exclusive
from tests.conftest import ROOT

UR5 = ROOT / "rigs" / "ur5.yaml"


@pytest.fixture
def taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Somebody else holds the arm; no device may be opened."""
    folder = tmp_path / "locks"
    monkeypatch.setenv(ENVIRONMENT, str(folder))
    folder.mkdir()

    def opened(*arguments: object) -> None:
        raise AssertionError("a device was opened")

    for place in (
        "flows.collecting.session.build_rig",
        "rigs.build.build_rig",
        "rigs.discovery.ping_devices",
    ):
        monkeypatch.setattr(f"sliplab.{place}", opened)
    name = next(iter(lock_names(load_rig_file(UR5)[0])))
    with exclusive(folder / name, "the arm", about={"store": "/data/other"}):
        yield


def run_request(folder: Path) -> RunRequest:
    file, text = load_rig_file(UR5)
    plan = load_plan(ROOT / "protocols" / "pilot.yaml")
    return RunRequest(plan, file, text, folder / "store", "pilot", ())


@pytest.mark.usefixtures("taken")
def test_collect_is_refused(tmp_path: Path) -> None:
    with (
        pytest.raises(
            Locked,
            match=r"the arm at .* is in use .*pid .* for the store /data/other",
        ),
        open_session(run_request(tmp_path)),
    ):
        pass
    # and takes the store's lock along: nothing stands in the way of another rig
    with exclusive(tmp_path / "store" / ".lock", "the store"):
        pass


@pytest.mark.usefixtures("taken")
def test_check_says_so(tmp_path: Path) -> None:
    (found,) = check_devices(run_request(tmp_path))
    assert (found.name, found.passed) == ("rig", False)
    assert "is in use by another program (pid" in found.finding


@pytest.mark.usefixtures("taken")
def test_teaching_and_calibrating_are_refused(tmp_path: Path) -> None:
    command = Measurement(UR5, tmp_path / "new.yaml", "plane", True)

    def never(session: CalibrationSession) -> MeasurementResult:
        raise AssertionError("measured")

    with pytest.raises(Locked, match="is in use"):
        command.run([], True, False, never)
    assert not (tmp_path / "new.yaml").exists()


@pytest.mark.usefixtures("taken")
def test_asking_whether_devices_answer_disturbs_nobody() -> None:
    about = _about(UR5, ask=True)
    assert about["wrong"]
    assert "is in use" in about["answer"]
    json.dumps(about)
