"""The command line as a person and as a program meet it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.cli import errors
from sliplab.storage.files import read_json
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import SECRET, SLIPLAB, here, sliplab, wait_for
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.flows.programs import NO_SERVER, environment, running


def test_plan_as_json() -> None:
    done = sliplab("plan", "protocols/gravity.yaml", "--json", "--rig", "rigs/mock.yaml")
    assert done.returncode == 0
    wide = here("plan", "protocols/kinematic.yaml", "--json", "--rig", "rigs/mock.yaml")
    for text, count in ((done.stdout, 180), (wide.stdout, 864)):
        data = json.loads(text)
        assert data["count"] == len(data["trials"]) == count
        assert min(data["seconds"], data["bytes"]) > 0


def test_plan_as_a_table() -> None:
    done = here("plan", "protocols/pilot.yaml")
    assert done.returncode == 0
    assert "36" in done.stdout
    assert "give --rig to estimate" in done.stdout


def test_wrong_input_is_exit_2_and_one_message(tmp_path: Path) -> None:
    data = tiny()
    data["collection"]["motion"][1]["sped"] = "1 mm/s"
    path = write(tmp_path / "wrong.yaml", data)
    for command in (
        ("plan", path),
        ("collect", path, "--rig", "rigs/mock.yaml", "--store", tmp_path / "s"),
        ("check", path, "--rig", "rigs/mock.yaml", "--store", tmp_path / "s"),
    ):
        done = here(*command)
        assert done.returncode == 2
        assert done.stdout == ""
        assert done.stderr.count("\n") == 1
        assert "collection.motion[1].sped" in done.stderr
        assert "did you mean 'speed'" in done.stderr
    assert not (tmp_path / "s").exists()


def test_an_exposure_longer_than_its_period_is_refused_by_plan_and_check(tmp_path: Path) -> None:
    rig = (ROOT / "rigs" / "ur5.yaml").read_text()
    assert "exposure_us: 2000" in rig
    path = tmp_path / "rig.yaml"
    path.write_text(rig.replace("exposure_us: 2000", "exposure_us: 20000"))
    for command in (("plan",), ("check", "--store", tmp_path / "s")):
        done = here(*command, "protocols/pilot.yaml", "--rig", path)
        assert (done.returncode, done.stdout) == (2, "")
        assert "devices.frame_camera.exposure_us = 20000: must be at most 10000" in done.stderr
        assert str(path) in done.stderr


def test_a_store_that_is_none_is_said() -> None:
    done = here("label", "docs")
    assert done.returncode == 2
    assert "is not a store" in done.stderr


def test_a_plan_that_does_not_fit_the_disk_is_refused(tmp_path: Path) -> None:
    rig = (ROOT / "rigs" / "mock.yaml").read_text()
    assert "bytes_per_frame: 27400" in rig
    path = tmp_path / "rig.yaml"
    path.write_text(rig.replace("bytes_per_frame: 27400", "bytes_per_frame: 1.0e+9"))
    done = here("collect", "protocols/pilot.yaml", "--rig", path, "--store", tmp_path / "s")
    assert done.returncode == 2
    assert "in reserve, the disk has" in done.stderr


def test_rigs_that_ship_are_known_by_name() -> None:
    needed = {}
    for name in ("mock", "rehearsal", "rigs/mock.yaml"):
        done = here("plan", "protocols/pilot.yaml", "--rig", name, "--json")
        assert done.returncode == 0, done.stderr
        needed[name] = json.loads(done.stdout)["bytes"]
    assert needed["mock"] == needed["rigs/mock.yaml"]
    # tracks instead of a video of 100 frames a second
    assert needed["rehearsal"] < 0.2 * needed["mock"]
    done = here("plan", "protocols/pilot.yaml", "--rig", "abacus")
    assert done.returncode == 2
    assert "not one of the shipped rigs: irb120, loopback, loopback_gripper, mock" in done.stderr


def test_check_looks_and_moves_nothing(tmp_path: Path) -> None:
    arguments = ("protocols/pilot.yaml", "--rig", "rigs/mock.yaml", "--store", tmp_path / "s")
    done = here("check", *arguments, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["passed"]
    names = {item["name"] for item in found["checks"]}
    assert {"arm", "clock: events", "clock: arm", "region", "space"} <= names
    (camera,) = (item for item in found["checks"] if item["name"] == "outside camera")
    assert camera["finding"] == "simulated video, 720 x 720 px"


def test_without_a_command_there_is_help_and_no_empty_error() -> None:
    done = here()
    assert (done.returncode, done.stderr) == (2, "")
    assert "collect" in done.stdout
    wrong = here("colect")
    assert wrong.returncode == 2
    assert "No such command 'colect'" in wrong.stderr


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Checksums of the small campaign's trials, collected in one go."""
    folder = tmp_path_factory.mktemp("undisturbed")
    path = write(folder / "p.yaml", tiny())
    done = here("collect", path, "--rig", "rehearsal", "--store", folder / "store")
    assert done.returncode == 0, done.stderr
    trials = folder / "store" / "campaigns" / "tiny" / "trials"
    return {trial.name: read_json(trial / "checksums.json") for trial in trials.iterdir()}


@pytest.mark.programs
@pytest.mark.quick(1)
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT, signal.SIGTERM])
def test_a_stopped_collection_goes_on_to_the_same_data(
    number: signal.Signals, tmp_path: Path, undisturbed: dict[str, Any]
) -> None:
    """Stopped in the middle of a trial, started again: the files of an undisturbed run."""
    path = write(tmp_path / "p.yaml", tiny())
    store = tmp_path / "stopped"
    command = ("collect", path, "--rig", "rehearsal", "--store", store, "--json")
    trials, aside = (store / "campaigns" / "tiny" / name for name in ("trials", "incoming"))
    secret = environment(**NO_SERVER, PREFECT_API_KEY=SECRET, AWS_SECRET_ACCESS_KEY=SECRET)
    with running([*SLIPLAB, *command], log := tmp_path / "messages", secret) as process:
        wait_for(
            lambda: trials.is_dir() and len(list(trials.iterdir())) >= 2 and any(aside.iterdir()),
            process,
        )
        process.send_signal(number)
        process.wait(timeout=60)
    if number is signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
    else:
        assert process.returncode == 130, log.read_text()
        assert "every committed trial is kept" in log.read_text()
    early = {folder.name: folder.stat().st_mtime_ns for folder in trials.iterdir()}
    assert 2 <= len(early) < 6
    again = here(*command)
    assert again.returncode == 0, again.stderr
    result = json.loads(again.stdout)
    counts = [result[name] for name in ("committed", "taken", "missing")]
    assert counts == [6, 6 - len(early), 0]
    assert all((trials / name).stat().st_mtime_ns == t for name, t in early.items())
    assert verify(TrialStore.open(store)) == []
    for name, expected in undisturbed.items():
        assert read_json(trials / name / "checksums.json") == expected
    for kept in store.rglob("*"):
        assert not kept.is_file() or SECRET.encode() not in kept.read_bytes(), kept


def test_collect_takes_so_many_trials_and_no_more(tmp_path: Path) -> None:
    arguments = ("protocols/pilot.yaml", "--rig", "rehearsal", "--store", tmp_path / "s")
    for taken, left_out in ((2, 34), (1, 33)):
        done = here("collect", *arguments, "--trials", taken, "--json")
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert (found["taken"], found["left_out"]) == (taken, left_out)
    assert (found["committed"], found["missing"]) == (3, 33)
    assert here("collect", *arguments, "--trials", 0).returncode == 2


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("status", "no longer watching"),
        ("alerts", "no longer watching; what waits is sent"),
        ("page", "the page is closed"),
        ("detect", "no longer detecting"),
        ("record", "every committed trial is kept; of an unfinished one"),
    ],
)
def test_an_endless_command_ends_in_plain_words(
    command: str, says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["sliplab", command, "store"])
    ended = errors.interruption()
    assert ended.exit_code == 130
    assert ended.message.startswith(f"interrupted: {says}")
    assert "half-written" not in ended.message


LATE = """
import os, signal, sys
class Late:
    def __del__(self, kill=os.kill, pid=os.getpid(), number=signal.{name}):
        kill(pid, number)  # when modules are cleared, after the program's own handlers are gone
sys.late = Late()
from sliplab.flows.__main__ import main
sys.argv = ["sliplab", "--version"]
main()
"""


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_while_the_interpreter_ends_changes_no_exit_code(name: str) -> None:
    done = subprocess.run([sys.executable, "-c", LATE.format(name=name)], capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
