"""A campaign of 40 trials driven from the page alone, in a real browser; the log says it all.

On `loopback`, whose real drivers work in real time, it takes some ten minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.log import log_entries
from sliplab.flows.running import run_records
from sliplab.flows.status import StatusReader
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.flows.browser import expect, launched, needs_browser
from tests.flows.conftest import write
from tests.flows.live import quick, rig_yaml
from tests.plugins.web.server.serving import serving, until

pytestmark = [needs_browser, pytest.mark.programs, pytest.mark.long]
TRIALS = 40
LIMIT_MS = 300_000
"""Of a run's begin and end: its program loads first."""


class Person:
    """Somebody at a browser who has opened the operator's link."""

    def __init__(self, browser: Any, link: str, name: str) -> None:
        self.name, self._root = name, link.partition("/enter")[0]
        self._context = browser.new_context()
        self.tab = self._context.new_page()
        self.tab.set_default_timeout(LIMIT_MS)
        self.tab.goto(link)
        self.tab.wait_for_url(f"{self._root}/")
        assert "token" not in self.tab.url

    def act(self, action: str, button: str, **fields: str) -> None:
        """Open an action, fill in its form and send it."""
        self.tab.goto(self._root)
        part = self.tab.locator("details", has=self.tab.locator("summary", has_text=action))
        part.locator("summary").click()
        part.get_by_label("Your name").fill(self.name)
        for label, text in fields.items():
            part.get_by_label(label).fill(text)
        part.get_by_role("button", name=button).click()
        self.tab.wait_for_url(f"{self._root}/")

    def start(self, protocol: str, count: int, why: str) -> None:
        """Start a run of a protocol."""
        self.tab.goto(self._root)
        part = self.tab.locator("details", has=self.tab.locator("summary", has_text="Start"))
        part.locator("summary").click()
        part.get_by_label("Protocol").select_option(label=protocol)
        part.get_by_label("Trials at most").fill(str(count))
        part.get_by_label("Your name").fill(self.name)
        part.get_by_label("Reason").fill(why)
        part.get_by_role("button", name="Start").click()
        self.tab.wait_for_url(f"{self._root}/")

    def stop(self) -> None:
        """One tap."""
        self.tab.goto(self._root)
        self.tab.get_by_role("button", name="Stop the arm").click()
        self.tab.wait_for_url(f"{self._root}/")

    def note(self, text: str, skin: str) -> None:
        """Add a note to the log, and another skin."""
        self.tab.goto(f"{self._root}/log")
        self.tab.get_by_label("Note", exact=True).fill(text)
        self.tab.get_by_label("New skin").fill(skin)
        self.tab.get_by_role("button", name="Add note").click()
        self.sees("td.text", text)
        self.tab.goto(self._root)

    def sees(self, place: str, text: str) -> None:
        """Wait until a part of the page has a text."""
        expect(self.tab.locator(place, has_text=text).first).to_be_visible(timeout=LIMIT_MS)


DRAWN = """() => [...document.querySelectorAll("#pictures canvas")].every((canvas) => {
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return canvas.width > 100 && new Set(data).size > 2;
})"""
"""Each camera has a picture of several brightnesses."""


def drive(browser: Any, link: str, folder: Path, protocol: str, planned: int) -> None:
    """Do what the first line says."""
    anna = Person(browser, link, "Anna")
    anna.start(protocol, TRIALS, "first night")
    anna.tab.wait_for_selector("#now .phase")
    anna.tab.wait_for_selector("#pictures canvas")
    anna.tab.wait_for_function(DRAWN)
    anna.act("Pause", "Pause after this trial", Reason="lens dirty")
    anna.sees("#status .notice", "Anna")
    anna.sees("#now .line", "paused before")
    anna.note("lens cleaned", "0043")
    anna.sees("#status li", "")  # what the new skin asks for
    anna.act("Resume", "Resume", Reason="")
    expect(anna.tab.locator("#status .notice")).to_have_count(0, timeout=LIMIT_MS)
    anna.stop()
    anna.sees("#now .big", "Nothing runs")
    store = TrialStore.open(folder)
    (status,) = StatusReader(store).read().campaigns
    assert status.committed < TRIALS
    ben = Person(browser, link, "Ben")
    ben.start(protocol, TRIALS - status.committed, "goes on")
    ben.sees("#status", f"{TRIALS} of {planned} done")
    ben.sees("#now .big", "Nothing runs")
    until("the end of its run", lambda: not run_records.open_runs(folder))
    (status,) = StatusReader(store).read().campaigns
    assert status.committed == TRIALS
    log = [(entry.what, entry.who, entry.text) for entry in log_entries(store)]
    assert ("pause", "Anna", "lens dirty") in log
    assert ("context", "Anna", "skin 0043, lens cleaned") in log
    assert set(status.skins) == {"simulated-1", "0043"}
    assert ("resume", "Anna", "") in log
    assert ("stop", "Anna", "") in log
    assert [who for what, who, _ in log if what == "session"] == ["Anna", "Ben"]
    ends = [text for what, _, text in log if what == "run" and text.startswith("collect")]
    assert "stopped" in ends[0]
    assert "completed" in ends[-1]


@pytest.mark.parametrize("name", ["rehearsal", "loopback"])
def test_campaign_is_driven_from_the_page_alone(name: str, tmp_path: Path) -> None:
    rig, protocol, planned, schedules = ROOT / "rigs" / f"{name}.yaml", "kinematic.yaml", 864, None
    if name == "loopback":  # in real time: 40 short slides, and an arm at an address of its own
        write(tmp_path / "quick.yaml", quick(trials=2, repetitions=TRIALS // 2))
        schedules = write(tmp_path / "schedules.yaml", {"timezone": "UTC", "schedules": []})
        rig, protocol, planned = rig_yaml(tmp_path), "quick.yaml", TRIALS
    store = tmp_path / "store"
    with (
        serving(store, rig, "page", None, tmp_path / "serve.log", schedules),
        launched() as browser,
    ):
        link = (store / ".prefect" / "operator-link").read_text().strip()
        drive(browser, link, store, protocol, planned)
