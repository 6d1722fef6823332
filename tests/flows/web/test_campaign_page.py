"""A campaign of 40 trials driven from the page alone, in a real browser; the log says it all."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.log import log_entries
from sliplab.flows.status import StatusReader
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT
from tests.flows.browser import launched, needs_browser, sync_api
from tests.flows.server.serving import serving

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

    def start(self, count: int, why: str) -> None:
        """Start a run of the kinematic protocol."""
        self.tab.goto(self._root)
        part = self.tab.locator("details", has=self.tab.locator("summary", has_text="Start"))
        part.locator("summary").click()
        part.get_by_label("Protocol").select_option(label="kinematic.yaml")
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

    def note(self, text: str) -> None:
        """Add a note to the log."""
        self.tab.goto(f"{self._root}/log")
        self.tab.get_by_label("Note", exact=True).fill(text)
        self.tab.get_by_role("button", name="Add note").click()
        self.sees("td.text", text)
        self.tab.goto(self._root)

    def sees(self, place: str, text: str) -> None:
        """Wait until a part of the page has a text."""
        expect = sync_api.expect
        expect(self.tab.locator(place, has_text=text).first).to_be_visible(timeout=LIMIT_MS)


def drive(browser: Any, link: str, folder: Path) -> None:
    """Do what the first line says."""
    anna = Person(browser, link, "Anna")
    anna.start(TRIALS, "first night")
    anna.tab.wait_for_selector("#now .phase")
    anna.tab.wait_for_selector("#pictures img")
    anna.act("Pause", "Pause after this trial", Reason="lens dirty")
    anna.sees("#status .notice", "Anna")
    anna.sees("#now .line", "paused before")
    anna.note("lens cleaned, new skin 0043")
    anna.act("Resume", "Resume", Reason="")
    sync_api.expect(anna.tab.locator("#status .notice")).to_have_count(0, timeout=LIMIT_MS)
    anna.stop()
    anna.sees("#now .big", "Nothing runs")
    store = Store.open(folder)
    (status,) = StatusReader(store).read().campaigns
    assert status.committed < TRIALS
    ben = Person(browser, link, "Ben")
    ben.start(TRIALS - status.committed, "goes on")
    ben.sees("#status", f"{TRIALS} of 864 done")
    ben.sees("#now .big", "Nothing runs")
    (status,) = StatusReader(store).read().campaigns
    assert status.committed == TRIALS
    log = [(entry.what, entry.who, entry.text) for entry in log_entries(store)]
    assert ("pause", "Anna", "lens dirty") in log
    assert ("note", "Anna", "lens cleaned, new skin 0043") in log
    assert ("resume", "Anna", "") in log
    assert ("stop", "Anna", "") in log
    assert [who for what, who, _ in log if what == "session"] == ["Anna", "Ben"]
    ends = [text for what, _, text in log if what == "run" and text.startswith("collect")]
    assert "stopped" in ends[0]
    assert "completed" in ends[-1]


def test_campaign_is_driven_from_the_page_alone(tmp_path: Path) -> None:
    rig, store = ROOT / "rigs" / "rehearsal.yaml", tmp_path / "store"
    with serving(store, rig, "page", None, tmp_path / "serve.log"), launched() as browser:
        drive(browser, (store / ".prefect" / "operator-link").read_text().strip(), store)
