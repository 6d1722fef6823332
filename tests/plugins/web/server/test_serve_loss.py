"""A service whose Prefect server stands still or dies while a campaign runs."""

from __future__ import annotations

import os
import signal
import urllib.error
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.flows.conftest import tiny, write
from tests.plugins.web.server.serving import FINAL, Page, processes, serving, until

pytestmark = pytest.mark.programs

RIG = ROOT / "rigs" / "rehearsal.yaml"


def final(page: Page, run: str) -> str:
    """The type of a run's last state; empty while it goes on, or nobody answers."""
    try:
        found = str(page.state(run)["type"])
    except (OSError, urllib.error.URLError):
        return ""
    return found if found in FINAL else ""


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_served_campaign_goes_on_without_its_server(
    number: signal.Signals, tmp_path: Path
) -> None:
    protocol = write(tmp_path / "protocol.yaml", tiny())
    store, log = tmp_path / "store", tmp_path / "log"
    trials = store / "campaigns" / "tiny" / "trials"
    nights = tmp_path / "schedules.yaml"  # its folder is one from which protocols may be named
    nights.write_text("timezone: UTC\nschedules: []\n")
    with serving(store, RIG, "lost", None, log, nights) as page:
        run = page.run("collect", protocol=str(protocol))["id"]
        until("a trial", lambda: trials.is_dir() and any(trials.iterdir()))
        (server,) = processes("sliplab.flows.running.embedded_server", str(store / ".prefect"))
        os.kill(server, number)
        until("all trials", lambda: len(list(trials.iterdir())) == 6)
        said = until("the end", lambda: final(page, run))
        assert said == "COMPLETED", log.read_text()
        assert log.read_text().count("warning: Prefect's server") == 1, log.read_text()
        label = page.run("label")["id"]
        assert page.ended(label)["type"] == "COMPLETED", log.read_text()
    assert "Traceback" not in (text := log.read_text()), text
