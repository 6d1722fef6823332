"""Leading a campaign from another terminal: real processes, real signals."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterable
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from sliplab.flows.collecting import requests
from sliplab.storage.process import this_process
from sliplab.storage.trials import control
from sliplab.storage.trials.lock import exclusive
from sliplab.storage.trials.store import TrialStore
from sliplab.storage.trials.verify import verify
from tests.command_line import SLIPLAB, answer, here, wait_for
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.flows.programs import NO_SERVER, environment, running

pytestmark = pytest.mark.programs

RIG = ROOT / "rigs" / "rehearsal.yaml"


def collecting(
    protocol: Path, store: Path, log: Path
) -> AbstractContextManager[subprocess.Popen[str]]:
    """`sliplab collect` in a process of its own."""
    command = ("collect", protocol, "--rig", RIG, "--store", store, "--json")
    return running([*SLIPLAB, *command], log, environment(**NO_SERVER))


def slides(folder: Path, degrees: Iterable[int]) -> Path:
    """The protocol of slides in these directions."""
    data = tiny()
    data["collection"]["factors"]["direction"]["values"] = [*degrees]
    data["analysis"]["split"] = {"method": "ranked"}
    return write(folder / "p.yaml", data)


def test_a_campaign_is_led_from_another_terminal(tmp_path: Path) -> None:
    protocol = slides(tmp_path, range(0, 360, 2))
    store, log = tmp_path / "store", tmp_path / "messages"
    trials = store / "campaigns" / "tiny" / "trials"
    with collecting(protocol, store, log) as process:
        wait_for(lambda: trials.is_dir() and any(trials.iterdir()), process)
        paused = answer("pause", store, "--who", "anna", "--why", "lunch")
        assert (paused["done"], paused["who"], paused["why"]) == (True, "anna", "lunch")
        assert paused["did"] == {"paused": True, "running": True}
        assert paused["holder"]["pid"] == process.pid
        there = {path.name for path in trials.iterdir()}
        assert not any((trials.parent / "incoming").iterdir())
        second = here("collect", protocol, "--rig", RIG, "--store", store)
        assert second.returncode == 1
        assert f"is paused (pause by anna, {paused['when']} (lunch))" in second.stderr
        first = min(there)
        anew = answer("again", store, first, "--why", "dust")
        assert anew["did"]["trials"][first].endswith("will be taken again")
        assert {path.name for path in trials.iterdir()} == there - {first}
        resumed = answer("resume", store)
        assert resumed["did"] == {"paused": False, "running": True}
        wait_for(lambda: len(list(trials.iterdir())) > len(there), process)
        stopped = answer("stop", store, "--why", "enough")
        assert stopped["did"] == {"stopped": True, "running": True}
        assert process.wait(timeout=60) == 130, log.read_text()
    assert "every committed trial is kept" in log.read_text()
    opened = TrialStore.open(store)
    assert [item.kind for item in control.requests(opened)] == ["pause", "again", "resume", "stop"]
    assert control.open_requests(opened) == []
    assert len(list(trials.iterdir())) < 180
    causes = {str(item["cause"]) for item in opened.campaign("tiny").quarantined()}
    assert causes <= {"again: dust", "stopped by a person"}
    assert [item for item in verify(opened) if item.kind != "unfinished"] == []


def test_between_collections_the_commands_act_themselves(tmp_path: Path) -> None:
    protocol, store = slides(tmp_path, (0, 60, 120)), tmp_path / "store"
    collect = ("collect", protocol, "--rig", RIG, "--store", store)
    assert here("pause", store).returncode == 2  # no store yet
    one = answer(*collect, "--trials", 1)
    assert (one["committed"], one["causes"]) == (1, [])
    assert answer("stop", store)["holder"] is None
    assert answer("pause", store)["did"] == {"paused": True, "running": False}
    assert here(*collect).returncode == 1
    assert answer("resume", store)["did"] == {"paused": False, "running": False}
    ids = {f"depth=2.4mm,direction={deg}deg,speed=1.6mmps,r=1" for deg in (0, 60, 120)}
    (done,) = (path.name for path in (store / "campaigns" / "tiny" / "trials").iterdir())
    skipped = min(ids - {done})
    wrong = here("skip", store, skipped.replace("2.4", "2.5"), "--why", "x")
    assert wrong.returncode == 2
    assert f"did you mean '{skipped}'" in wrong.stderr
    assert here("skip", store, skipped).returncode == 2
    assert here("again", store, skipped, "--why", " ").returncode == 2
    did = answer("skip", store, skipped, "--why", "cable in the way", "--who", "anna")["did"]
    assert did["trials"] == {skipped: "set aside"}
    rest = here(*collect)
    assert rest.returncode == 1  # not every trial was taken
    words = "".join(rest.stdout.split())
    for said in ("1excludedtrial(", "anna", "cableintheway"):
        assert said in words
    listed = answer("trials", store)
    assert listed["count"] == 2
    (aside,) = listed["set_aside"]
    assert (aside["trial"], aside["by"], aside["cause"]) == (skipped, "anna", "cable in the way")
    assert "cable in the way" in " ".join(here("trials", store).stdout.split())
    answer("again", store, skipped, done, "--why", "new cable")
    whole = answer(*collect)
    assert (whole["committed"], whole["taken"], whole["quarantined"]) == (3, 2, 1)
    assert answer("trials", store)["set_aside"] == []
    assert verify(TrialStore.open(store)) == []


def test_a_pause_and_what_was_asked_for_outlive_a_kill(tmp_path: Path) -> None:
    protocol, store = slides(tmp_path, range(0, 360, 2)), tmp_path / "store"
    trials = store / "campaigns" / "tiny" / "trials"
    with collecting(protocol, store, tmp_path / "messages") as process:
        wait_for(lambda: trials.is_dir() and any(trials.iterdir()), process)
        assert answer("pause", store)["did"]["running"]
        process.kill()
        process.wait(timeout=60)
    first = min(path.name for path in trials.iterdir())
    opened = TrialStore.open(store)
    control.ask(opened, "again", campaign="tiny", trials=(first,), why="dust")  # and killed, too
    collect = ("collect", protocol, "--rig", RIG, "--store", store, "--trials", 1)
    assert here(*collect).returncode == 1
    assert answer("resume", store)["did"] == {"paused": False, "running": False}
    assert not (trials / first).exists()
    assert answer(*collect)["taken"] == 1
    assert (trials / first).exists()
    assert verify(opened) == []


SLEEPER = "import sys; print('up', flush=True); sys.stdin.read()"
HOLDER = """
import json, sys
from pathlib import Path
from sliplab.storage.trials.lock import exclusive
from sliplab.storage.process import this_process
with exclusive(Path(sys.argv[1]), "the store"):
    print(json.dumps(this_process()), flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("script", [SLEEPER, HOLDER])
def test_stop_signals_nothing_but_a_collection(script: str, tmp_path: Path) -> None:
    """Neither whom a stale lock names, nor who holds the lock for something else."""
    store = TrialStore.create(tmp_path / "s")
    process = subprocess.Popen(
        [sys.executable, "-c", script, store.folder / ".lock"],
        cwd=ROOT,
        env=environment(),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline()
        if script == SLEEPER:
            stale = {**this_process(), "pid": process.pid, "collects": "tiny"}
            (store.folder / ".lock").write_text(json.dumps(stale))
        outcome = requests.stop_collection(store, limit_s=1.0)
        assert outcome.holder is None
        assert process.poll() is None
    finally:
        process.stdin.close()
        process.wait(timeout=60)
        process.stdout.close()
    assert process.returncode == 0


def test_waiting_for_a_trial_to_end_is_bounded_and_the_request_stands(tmp_path: Path) -> None:
    store = TrialStore.create(tmp_path / "s")
    begin = time.monotonic()
    with exclusive(store.folder / ".lock", "the store", about={"collects": "tiny"}):
        outcome = requests.ask(store, "pause", limit_s=1.0)
        assert outcome.answer is None
        assert outcome.holder is not None
        assert outcome.as_json()["done"] is False
    assert time.monotonic() - begin < 30
    assert control.paused(store) == outcome.request
    assert requests.ask(store, "resume").answer is not None
    assert control.open_requests(store) == []
