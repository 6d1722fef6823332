"""Runs of a service that are killed, or suspended from Prefect's page."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from sliplab.storage.files import read_json
from sliplab.storage.remote.objects import LAYOUT_FILE
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.flows.server.serving import serving, until

pytestmark = pytest.mark.programs

RIG = ROOT / "rigs" / "rehearsal.yaml"


def process_of(run: str) -> int:
    """The process that carries out a run; 0 where there is none."""
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_text().split("\0")
        except OSError:  # it has ended meanwhile
            continue
        if "sliplab.flows.server.runs" in words and run in words:
            return int(path.parent.name)
    return 0


def test_a_killed_run_is_closed_and_a_suspended_one_goes_on(tmp_path: Path) -> None:
    protocol = write(tmp_path / "protocol.yaml", tiny())
    store, log = tmp_path / "store", tmp_path / "log"
    trials, records = store / "campaigns" / "tiny" / "trials", store / "control" / "runs"
    nights = tmp_path / "schedules.yaml"  # its folder is one from which protocols may be named
    nights.write_text("timezone: UTC\nschedules: []\n")
    with serving(store, RIG, "ends", None, log, nights) as page:
        killed = page.run("collect", protocol=str(protocol))["id"]
        until("a trial", lambda: trials.is_dir() and any(trials.iterdir()))
        os.kill(process_of(killed), signal.SIGKILL)
        said = page.ended(killed)
        assert (said["type"], said["message"]) == ("CRASHED", "its process was killed (-9)")
        assert len(list(trials.iterdir())) < 6

        suspended = page.run("collect", protocol=str(protocol))["id"]
        until("a run", lambda: page.state(suspended)["type"] == "RUNNING")
        paused = {
            "type": "PAUSED",
            "name": "Suspended",
            "state_details": {"pause_reschedule": True},
        }
        answer = page.call(f"/flow_runs/{suspended}/set_state", {"state": paused})
        assert answer["status"] == "ACCEPT", answer
        until("its process", lambda: not process_of(suspended))
        assert page.state(suspended)["type"] == "PAUSED"
        page.call(f"/flow_runs/{suspended}/resume", {})
        assert page.ended(suspended)["type"] == "COMPLETED", log.read_text()
        assert len(list(trials.iterdir())) == 6
    ends = [read_json(path) for path in records.glob("*.end.json")]
    assert sorted((end["state"], end["by"]) for end in ends) == [
        ("COMPLETED", "flow"),
        ("CRASHED", "service"),
    ]


def test_a_push_that_hangs_delays_no_collection(tmp_path: Path) -> None:
    """The remote place answers nothing: its marker is a pipe that nobody writes to."""
    protocol = write(tmp_path / "protocol.yaml", tiny())
    store, log, remote = tmp_path / "store", tmp_path / "log", tmp_path / "remote"
    remote.mkdir()
    os.mkfifo(remote / LAYOUT_FILE)
    nights = tmp_path / "schedules.yaml"
    nights.write_text(
        "timezone: UTC\nschedules:\n"
        f"  - {{name: copy, flow: push, url: 'file://{remote}', cron: '0 0 1 1 *'}}\n"
    )
    Store.create(store)
    with serving(store, RIG, "beside", None, log, nights) as page:
        pushing = page.run("push")["id"]
        until("the push", lambda: page.state(pushing)["type"] == "RUNNING")
        taking = page.run("collect", protocol=str(protocol))["id"]
        said = page.ended(taking)
        assert said["type"] == "COMPLETED", log.read_text()
        assert page.state(pushing)["type"] == "RUNNING"
        page.cancel(pushing)
        assert page.ended(pushing)["type"] == "CANCELLED"
