"""Review and trials in a real browser: what a person does is kept, and nobody else gets in."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any
from urllib.error import HTTPError
from urllib.parse import quote, urljoin, urlsplit
from urllib.request import Request, urlopen

import pytest

from sliplab.storage.trials import review
from tests.analysis.labels.reviewable import DOUBTFUL, NAME, Reviewable, label
from tests.conftest import ROOT
from tests.flows.browser import PATIENCE_MS, expect, launched, needs_browser

TRIALS = 864
pytestmark = [pytest.mark.programs, needs_browser]


@dataclass
class Served:
    """A server of its own process over the 864 trials, and a browser."""

    made: Reviewable
    reported: dict[str, Any]
    process: subprocess.Popen[str]
    browser: Any


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """Ends with Ctrl-C, which must end it in good order."""
    made = Reviewable(tmp_path_factory.mktemp("review") / "store")
    process = subprocess.Popen(
        [sys.executable, "-m", "sliplab", "review", str(made.store.folder), "--json", "--who=anna"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONWARNINGS": "default"},
    )
    try:
        reported = json.loads(process.stdout.readline())
        with launched() as browser:
            yield Served(made, reported, process, browser)
    finally:
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=30)
    assert process.returncode == 130, err
    assert out == ""
    assert "Traceback" not in err


@dataclass
class Tab:
    """One tab, and what its console said amiss."""

    page: Any
    amiss: list[str]

    def rows(self) -> Any:
        return self.page.get_by_role("option", include_hidden=True).and_(
            self.page.locator("[aria-posinset]")
        )

    def row(self, trial: str) -> Any:
        return self.rows().filter(has=self.page.get_by_text(trial, exact=True))

    def decision(self, trial: str) -> Any:
        return self.row(trial).locator(".status")

    def heading(self) -> Any:
        return self.page.locator(".heading h2")

    def chosen(self) -> Any:
        return self.page.locator(".heading .id")

    def press(self, key: str) -> None:
        self.page.keyboard.press(key)

    def find(self, text: str) -> None:
        """Only trials whose id holds this."""
        box = self.page.get_by_label("Id holds")
        box.fill(text)
        box.press("Escape")

    def at(self, time_s: float) -> float:
        """Return a time's x position in the displacement plot, pixels from the window's left."""
        plot = self.page.locator(".plot svg").first
        plot.scroll_into_view_if_needed()
        area = plot.locator(".area").bounding_box()
        start, end = (float(plot.get_attribute(f"data-{side}")) for side in ("start", "end"))
        self.top, self.high = area["y"], area["height"]
        return float(area["x"] + (time_s - start) / (end - start) * area["width"])

    def drag(self, from_s: float, to_s: float) -> None:
        """Drag what stands at a time to another."""
        mouse, begin, end = self.page.mouse, self.at(from_s), self.at(to_s)
        height = self.top + 0.3 * self.high
        mouse.move(begin, height)
        mouse.down()
        mouse.move((begin + end) / 2, height, steps=3)
        mouse.move(end, height, steps=3)
        mouse.up()


@pytest.fixture
def tab(served: Served) -> Iterator[Tab]:
    """A fresh tab; nothing in it may go wrong."""
    yield from opened(served)


def opened(served: Served) -> Iterator[Tab]:
    page = served.browser.new_page(viewport={"width": 1400, "height": 960})
    page.set_default_timeout(PATIENCE_MS)
    amiss: list[str] = []
    decision = "/review/decision"  # one that is refused is an answer, too

    def printed(message: Any) -> None:
        here = message.location.get("url", "")
        if message.type in {"error", "warning"} and not here.endswith(decision):
            amiss.append(message.text)

    def answered(response: Any) -> None:
        fine = {409, 422} if response.url.endswith(decision) else set()
        if response.status >= 400 and response.status not in fine:
            amiss.append(f"{response.status} {response.url}")

    page.on("console", printed)
    page.on("pageerror", lambda error: amiss.append(str(error)))
    page.on("response", answered)
    page.on(
        "request", lambda r: None if r.url.startswith("http://127.0.0.1:") else amiss.append(r.url)
    )
    page.goto(served.reported["url"])
    found = Tab(page, amiss)
    expect(found.chosen()).to_contain_text("1 of ")
    yield found
    page.close()
    assert amiss == []


def test_all_trials_are_listed_doubtful_ones_first(served: Served, tab: Tab) -> None:
    assert served.reported["trials"] == served.reported["to_decide"] == TRIALS
    doubtful = served.made.ids[DOUBTFUL]
    expect(tab.page.get_by_text(f"{TRIALS} trials, {TRIALS} to review")).to_be_visible()
    expect(tab.chosen()).to_have_text(f"{NAME} / {doubtful} · 1 of {TRIALS}")
    expect(tab.page.locator("li.doubt").first).to_contain_text("marker 3 could not be followed")
    # only what is seen stands in the page, however long the list
    assert 5 < tab.rows().count() < 60
    tab.press("n")
    expect(tab.chosen()).to_have_text(f"{NAME} / {served.made.ids[0]} · 2 of {TRIALS}")
    tab.press("ArrowDown")
    expect(tab.chosen()).to_have_text(f"{NAME} / {served.made.ids[1]} · 3 of {TRIALS}")
    tab.press("p")
    expect(tab.chosen()).to_have_text(f"{NAME} / {served.made.ids[0]} · 2 of {TRIALS}")
    tab.page.get_by_label("doubtful first").uncheck()
    expect(tab.chosen()).to_contain_text(served.made.ids[0])
    tab.page.get_by_label("Decision").select_option("doubtful")
    expect(tab.page.get_by_text("1 trial, 1 to review")).to_be_visible()
    tab.page.get_by_label("Decision").select_option("all")
    tab.find(served.made.ids[-1])
    expect(tab.row(served.made.ids[-1])).to_be_visible()
    expect(tab.rows()).to_have_count(1)


def test_a_click_takes_the_row_that_is_seen_while_the_list_changes(
    served: Served, tab: Tab
) -> None:
    def slowly(change: Callable[[], None], trial: str) -> None:
        """The click comes before the server's answer to the change."""
        served.process.send_signal(signal.SIGSTOP)
        try:
            change()
            tab.row(trial).click()
        finally:
            served.process.send_signal(signal.SIGCONT)
        expect(tab.chosen()).to_contain_text(trial)
        selected = tab.page.locator("[role=option][aria-selected=true]")
        expect(selected).to_have_count(1)
        expect(selected).to_contain_text(trial)

    doubtful, first, other = (served.made.ids[place] for place in (DOUBTFUL, 0, 20))
    slowly(lambda: tab.find(other), other)  # the only one that is left
    expect(tab.rows()).to_have_count(1)
    tab.find("")
    expect(tab.row(doubtful)).to_be_visible()
    slowly(tab.page.get_by_label("doubtful first").uncheck, first)  # elsewhere in the list


def test_the_frame_under_the_cursor_is_shown(tab: Tab) -> None:
    tab.press("n")
    expect(tab.chosen()).to_contain_text("2 of ")  # a trial that comes later takes the cursor along
    expect(tab.heading()).to_contain_text("simulated")
    caption = tab.page.get_by_text(re.compile(r"^frame \d+ at"))
    for time_s, frame in ((0.1051, 10), (0.4951, 49)):
        tab.page.mouse.move(tab.at(time_s), tab.top + 0.5 * tab.high)
        expect(caption).to_have_text(f"frame {frame} at {0.005 + frame / 100:.3f} s")
    tab.press("ArrowLeft")
    expect(caption).to_have_text("frame 48 at 0.485 s")


def test_a_dragged_onset_and_a_rejection_are_kept(served: Served, tab: Tab) -> None:
    one, two = served.made.ids[10:12]
    known = label()
    tab.find("")
    for trial in (one, two):
        tab.find(trial)
        tab.row(trial).click()
        expect(tab.chosen()).to_contain_text(trial)
        if trial == one:
            tab.drag(known["incipient_ns"] / 1e9, 0.25)
            moved = tab.page.locator("tr", has=tab.page.get_by_text("incipient", exact=True))
            expect(moved.locator("td").nth(1)).to_have_text(re.compile(r"0\.2[45]\d\d s"))
            reported = moved.locator("td").nth(1).inner_text()
            tab.press("s")
            expect(tab.decision(trial)).to_have_text("adjusted")
        else:
            tab.page.get_by_role("button", name="Reject").click()
            expect(tab.page.get_by_text("Not saved: a rejection needs a reason")).to_be_visible()
            tab.press("r")
            tab.page.keyboard.type("<img src=x onerror=\"document.title='taken'\">")
            tab.page.get_by_role("button", name="Reject").click()
            expect(tab.decision(trial)).to_have_text("rejected")
    tab.page.reload()
    expect(tab.chosen()).to_contain_text(f"{TRIALS} of ")  # decided ones come last
    for trial, state in ((one, "adjusted"), (two, "rejected")):
        tab.find(trial)
        expect(tab.decision(trial)).to_have_text(state)
        tab.row(trial).click()
        expect(tab.heading()).to_contain_text(f"{state} by anna")
        history = tab.page.locator(".past tr").nth(1)
        if trial == one:
            line = tab.page.locator("tr", has=tab.page.get_by_text("incipient", exact=True))
            expect(line.locator("td").nth(1)).to_have_text(reported)
        else:
            expect(history.locator("td").last).to_contain_text("<img src=x")
    assert tab.page.title() == "Review · store"

    made = review.last(served.made.store, NAME, one)
    assert (made.verdict, made.who, made.label) == ("adjust", "anna", served.made.keys[one])
    assert (made.old.incipient_ns, made.old.gross_ns) == (known["incipient_ns"], known["gross_ns"])
    assert made.new.incipient_ns == round(float(reported.removesuffix(" s")) * 1e9)
    assert made.new.gross_ns == known["gross_ns"]  # not moved: to the nanosecond
    made = review.last(served.made.store, NAME, two)
    assert (made.verdict, made.new) == ("reject", review.ReviewedOnsets())


@pytest.mark.long
def test_two_reviewers_of_one_trial_do_not_undo_each_other(served: Served, tab: Tab) -> None:
    trial = served.made.ids[20]
    tab.find(trial)
    tab.row(trial).click()
    expect(tab.chosen()).to_contain_text(trial)
    # another program, between this reviewer's look and this reviewer's key
    known = label()
    onsets = review.ReviewedOnsets(known["incipient_ns"], known["gross_ns"])
    known = {
        "label": served.made.keys[trial],
        "old": onsets,
        "new": review.ReviewedOnsets(),
        "seen": 0,
    }
    review.decide(served.made.store, NAME, trial, "reject", **known, who="bert", why="blurred")
    tab.press("a")
    # either the page knew already, and this is a second decision, or it says so
    expect(tab.page.locator(".past")).to_contain_text("bert")
    expect(tab.page.locator(".past")).to_contain_text("blurred")
    kept = review.history(served.made.store, NAME, trial)
    assert (kept[0].verdict, kept[0].who) == ("reject", "bert")
    assert all(item.number == place + 1 for place, item in enumerate(kept))


@pytest.mark.parametrize("width", [390, 1400])
def test_a_trial_has_its_curves_and_frames_on_any_screen(
    served: Served, tab: Tab, width: int
) -> None:
    page, trial = tab.page, served.made.ids[0]
    page.set_viewport_size({"width": width, "height": 900})
    sideways = "document.documentElement.scrollWidth > innerWidth"
    assert not page.evaluate(sideways)
    tab.heading().scroll_into_view_if_needed()
    page.goto(urljoin(page.url, "/trials"))
    assert not page.evaluate(sideways)
    page.get_by_label("Id holds").fill(trial)
    page.keyboard.press("Enter")
    page.get_by_role("link", name=trial, exact=True).click()
    expect(page.locator(".plot path.curve")).to_have_count(7 + 1 + 1)  # markers, events, speed
    expect(page.get_by_text(re.compile(r"^frame \d+ at"))).to_be_visible()
    page.get_by_role("slider", name="Frame").fill("12")
    expect(page.get_by_text("frame 12 at 0.125 s")).to_be_visible()
    page.get_by_role("button", name="Check every byte").click()
    expect(page.get_by_text("all intact")).to_be_visible()
    assert not page.evaluate(sideways)


def test_nobody_else_gets_in(served: Served) -> None:
    parts = urlsplit(served.reported["url"])
    assert parts.hostname == "127.0.0.1"
    assert parts.port is not None
    assert len(parts.query) > 40
    root = f"http://{parts.netloc}"
    refused = (
        ({}, 401),  # without the link's token
        ({"Cookie": f"sliplab-{parts.port}=operator.guess.guess"}, 401),
        ({"Host": f"evil.example:{parts.port}"}, 421),  # a name that was pointed here
        ({"Host": "127.0.0.1:1"}, 421),
        ({"Origin": "http://evil.example"}, 403),
        ({"Origin": "null"}, 403),
    )
    trial = f"{NAME}/{quote(served.made.ids[0])}"
    paths = ("/", "/review", "/review/rows", f"/review/{trial}", f"/trials/{trial}/frame?frame=0")
    for headers, status in refused:
        for path in paths:
            with pytest.raises(HTTPError) as error:
                urlopen(Request(root + path, headers=headers), timeout=10)
            assert (path, error.value.code) == (path, status)
            error.value.close()
    with pytest.raises(HTTPError) as error:
        urlopen(f"{root}/enter?token=guess&to=/review", timeout=10)
    assert error.value.code == 403
    error.value.close()
    inside = socket.gethostbyname(socket.gethostname())
    if not inside.startswith("127."):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((inside, parts.port), timeout=5)
