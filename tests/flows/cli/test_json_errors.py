"""Errors of every command under ``--json``: one object for programs, and its exit code."""

from __future__ import annotations

import importlib
import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import typer

from sliplab.flows.cli import errors
from sliplab.flows.cli.app import command_line
from sliplab.flows.running import stopping
from sliplab.flows.running.cluster import ClusterError
from sliplab.rigs.core.capabilities import ArmFault
from sliplab.rigs.core.guard import DepthError
from sliplab.storage.errors import StoreError
from sliplab.storage.trials.store import TrialStore
from tests.analysis.labels.reviewable import Reviewable
from tests.command_line import SECRET, here
from tests.conftest import ROOT
from tests.packages import write_metadata

KEYS = ["file", "key", "value", "message", "exit_code"]
GONE = "ROOM/nowhere"
"""A file that is not there; ROOM is a folder."""
ALONE = (
    *("plan", "sync", "label", "train", "evaluate", "report", "generalise", "trials"),
    *("holdout", "verify", "migrate", "pause", "resume", "stop", "review", "reflex", "stress"),
    *("tradeoff", "status", "log", "page"),
)
WRONG: dict[str, tuple[str, str | None, str | None, str | None]] = {
    # command: arguments, and the file, key and value that its error names
    **dict.fromkeys(ALONE, (GONE, GONE, None, None)),
    **{
        name: (words, GONE, None, None)
        for name, words in {
            "align": f"{GONE} ROOM/file",
            "record": f"{GONE} --store ROOM/s --campaign c",
            "check": f"{GONE} --rig mock --store ROOM/s",
            "register": f"{GONE} --store ROOM/s",
            "collect": f"{GONE} --rig mock --store ROOM/s",
            "push": f"{GONE} file://ROOM/u",
            "skip": f"{GONE} x --why torn",
            "import": f"{GONE} --store ROOM/i --name n",
            "export": f"{GONE} x --output ROOM/o",
            "publish": f"{GONE} --as croissant --output ROOM/o",
            "alerts": f"{GONE} ROOM/file",
            "view": f"{GONE} x",
            "detect": f"--rig mock --model {GONE}",
            "export-model": f"{GONE} --out ROOM/e",
            "power": f"pilot --store {GONE}",
            "teach plane": f"--rig {GONE}",
            "teach zero": f"--rig {GONE}",
            "teach tool": f"--rig {GONE}",
            "calibrate lens": f"--rig {GONE}",
            "calibrate crop": f"--rig {GONE}",
            "calibrate detector": f"--rig {GONE}",
            "calibrate scene": f"{GONE} --rig mock --out ROOM/t.yaml",
            "calibrate drift": f"{GONE} --rig mock",
            "calibrate gap": f"{GONE} --rig t.yaml --protocol pilot --out ROOM/g",
        }.items()
    },
    "pull": (f"file://{GONE} ROOM/p", f"file://{GONE}", None, None),
    "demo": ("ROOM/file", "ROOM/file", None, None),
    "serve": ("--store ROOM/file --rig mock", "ROOM/file", None, None),
    "study": (f"{GONE} --status", None, "FOLDER", GONE),
    "guesses": (GONE, None, "COMMAND", "guesses"),
    "rigs": ("--sped", None, "--sped", None),
    "again": (f"{GONE}|x|--why| ", None, "--why", ""),
    "bench": ("nobody --folder ROOM/b", None, "DETECTOR", "nobody"),
    "schema": ("robot", None, "KIND", "robot"),
    "new driver": ("Lab-Arm --into ROOM", None, "NAME", "Lab-Arm"),
    "calibrate board": ("--out ROOM/x.doc", None, "--out", "ROOM/x.doc"),
}


def commands() -> Iterator[str]:
    """All commands of the command line, by the words that call them."""

    def walk(group: Any, words: tuple[str, ...]) -> Iterator[str]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from walk(command, (*words, name))
            else:
                yield " ".join((*words, name))

    return walk(typer.main.get_command(command_line()), ())


def error_of(*words: object) -> dict[str, Any]:
    """The error that a command printed as its one JSON object; its exit code stands in it."""
    done = here(*words, "--json")
    assert "Traceback" not in done.stderr
    (line,) = done.stdout.splitlines()
    data = json.loads(line)
    assert list(data) == ["error"]
    error: dict[str, Any] = data["error"]
    assert list(error) == KEYS
    assert error["exit_code"] == done.returncode
    assert error["message"] in done.stderr
    return error


def test_the_table_has_every_command() -> None:
    assert set(WRONG) == set(commands())


@pytest.mark.parametrize("name", WRONG)
def test_wrong_input_is_one_object_and_exit_2(name: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no store")
    before = sorted(tmp_path.rglob("*"))
    words, *named = WRONG[name]

    def placed(text: str | None) -> str | None:
        return None if text is None else text.replace("ROOM", str(tmp_path))

    arguments = words.split("|") if "|" in words else words.split()
    error = error_of(*name.split(), *map(placed, arguments))
    assert error["exit_code"] == 2
    assert [error["file"], error["key"], error["value"]] == [placed(text) for text in named]
    assert error["message"]
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("name", list(WRONG))
def test_usage_errors_are_objects_too(name: str) -> None:
    error = error_of(*name.split(), "--no-such-option")
    assert (error["exit_code"], error["key"]) == (2, "--no-such-option")


@pytest.mark.parametrize(
    ("words", "key", "value"),
    [
        ((), "--json", None),
        (("colect",), None, None),
        (("teach",), "--json", None),
        (("plan",), "PROTOCOL", None),
        (("collect", "p.yaml", "--rig", "mock"), "--store", None),
        (("serve", "--rig", "mock", "--store", "s", "--port", "99999"), "--port", "99999"),
        (("evaluate", "s", "--smoothing", "many"), "--smoothing", "many"),
        (("teach", "plane", "--rig", "mock", "--by", "foot"), "--by", "foot"),
        (("trials", "s3://anna:geheim@host/s"), "URL", "s3://.../s"),
    ],
)
def test_options_and_arguments_are_named(
    words: tuple[str, ...], key: str | None, value: str | None
) -> None:
    error = error_of(*words)
    found = tuple(error[name] for name in ("exit_code", "file", "key", "value"))
    assert found == (2, None, key, value)


@pytest.mark.parametrize("place", ["ROOM", "ROOM/file", "file://ROOM/nowhere"])
@pytest.mark.parametrize("name", ["trials", "verify", "sync", "label", "report"])
def test_a_missing_store_is_exit_2_wherever_it_was_looked_for(
    name: str, place: str, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("no store")
    where = place.replace("ROOM", str(tmp_path))
    error = error_of(name, where)
    assert (error["exit_code"], error["file"]) == (2, where)


def test_one_object_after_a_result_was_printed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Review prints its address first; what ends it later must not be a second object."""
    from sliplab.plugins.web.pages import serving

    def serve(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(serving, "serve", serve)
    made = Reviewable(tmp_path / "s", 1)
    done = here("review", made.store.folder, "--json")
    assert done.returncode == 130
    assert list(json.loads(done.stdout)) == ["url", "trials", "to_decide"]


def test_a_trial_that_was_shown_is_an_object_too(monkeypatch: pytest.MonkeyPatch) -> None:
    from sliplab.plugins.view import view

    monkeypatch.setattr(view, "find", lambda *_: None)
    monkeypatch.setattr(view, "show", lambda _: None)
    monkeypatch.setattr("sliplab.storage.remote.mirror.open_store", lambda _: None)
    done = here("view", "s", "depth=1mm", "--json")
    assert json.loads(done.stdout) == {"trial": "depth=1mm", "file": None}


@pytest.mark.parametrize(
    ("raised", "code", "message"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (ClusterError("--dask h:1: no scheduler answers"), 1, "no scheduler answers"),
        (StoreError("s: holds trials that the protocol no longer has"), 1, "no longer has"),
        (ZeroDivisionError("division by zero"), 1, "division by zero"),
        (AssertionError(), 1, "AssertionError"),
        (StoreError(f"https://anna:geheim-1@host/s with {SECRET}: no"), 1, "https://anna:****@"),
    ],
)
def test_whatever_ends_a_command_is_an_object(
    raised: BaseException, code: int, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise raised

    monkeypatch.setenv("PREFECT_API_KEY", SECRET)
    monkeypatch.setattr("sliplab.protocols.plan.load_plan", fail)
    done = here("plan", ROOT / "protocols" / "pilot.yaml", "--json")
    error = json.loads(done.stdout)["error"]
    assert (done.returncode, error["exit_code"]) == (code, code)
    assert message in error["message"]
    assert "geheim" not in done.stdout + done.stderr
    assert SECRET not in done.stdout + done.stderr
    plain = here("plan", ROOT / "protocols" / "pilot.yaml")
    assert (plain.returncode, plain.stdout) == (code, "")
    assert not stopping.requested()


def test_an_arm_that_does_not_stop_is_said_to_whoever_pressed_ctrl_c(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        with suppress(KeyboardInterrupt):
            stopping.stop()
        raise ArmFault("arm", "does not stop: press its emergency stop")

    monkeypatch.setattr("sliplab.protocols.plan.load_plan", interrupted)
    done = here("plan", ROOT / "protocols" / "pilot.yaml", "--json")
    assert done.returncode == 1
    assert "press its emergency stop" in done.stderr
    assert "press its emergency stop" in json.loads(done.stdout)["error"]["message"]


@pytest.mark.parametrize("command", ["plan", "register", "power", "verify", "collect", "label"])
def test_interrupted_command_names_trials_only_where_it_resumes_them(
    command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["sliplab", command, "x", "--json"])
    found = errors.interruption().message
    assert found.startswith("interrupted: ")
    assert ("trial" in found) == (command in {"collect", "label"})
    assert "run the same command" in found


def test_a_missing_file_of_a_store_is_named(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    (store.folder / "store.json").write_text("{")
    error = error_of("trials", store.folder)
    assert (error["exit_code"], error["file"]) == (1, str(store.folder / "store.json"))


def test_a_pose_beyond_a_limit_is_no_bug_of_the_program() -> None:
    found = errors.failure(DepthError("depth in contact", 4.1, 3.6, "mm", "the arm was stopped"))
    assert (found.trace, found.exit_code) == ("", 1)
    assert "4.1 mm is beyond its limit 3.6 mm" in found.message
    assert "RuntimeWarning" in errors.failure(RuntimeWarning("a bug")).trace


def test_fault_in_the_code_of_a_package_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = "from json import loads\ndef fail(*_):\n    return loads('{')\n"
    (tmp_path / "lab_faulty.py").write_text(text)
    write_metadata(tmp_path, "lab-faulty", {"sliplab.plugins": {"faulty": "lab_faulty:PLUGIN"}})
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(ValueError, match="Expecting") as raised:
        importlib.import_module("lab_faulty").fail()
    found = errors.failure(raised.value)
    where = f"the package lab-faulty 1.0 fails in {tmp_path / 'lab_faulty.py'}:3"
    assert found.message.startswith(f"{where}: JSONDecodeError: Expecting")
    assert found.trace == ""
