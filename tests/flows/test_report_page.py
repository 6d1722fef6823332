"""The report in a real browser: nothing runs out of the page, and no figure is empty."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from sliplab.analysis.report.sources import report_folder
from sliplab.flows.report import against
from sliplab.storage.trials.store import TrialStore
from tests.flows.browser import PATIENCE_MS, launched, needs_browser
from tests.flows.conftest import Ran

pytestmark = needs_browser
PAPER_PX = 703
"""A4 without its margins, at 96 pixels an inch."""

OUTSIDE = """() => [...document.querySelectorAll('body *')].filter((e) => {
  const box = e.getBoundingClientRect();
  return box.width && box.right > window.innerWidth + 1 && !e.closest('.scroll');
}).map((e) => e.tagName + ' ' + e.textContent.slice(0, 60))"""
"""Elements that overflow the window, except those inside a scrolling box."""

EMPTY = """() => [...document.querySelectorAll('figure')].filter((e) => {
  const svg = e.querySelector('svg'), box = svg && svg.getBoundingClientRect();
  return !svg || box.width < 200 || box.height < 80 ||
    svg.querySelectorAll('path, use, image, rect').length < 3 ||
    svg.querySelectorAll('text').length < 3 || !e.querySelector('figcaption').innerText.trim();
}).map((e) => e.id)"""


@pytest.fixture(scope="module")
def folder(ran: Ran, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the small study's report, compared with itself."""
    store = tmp_path_factory.mktemp("page") / "store"
    shutil.copytree(ran[0][0].store, store, ignore=shutil.ignore_patterns("trials"))
    found = TrialStore.open(store)
    against(found, store)
    return report_folder(found)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", ["index.html", "against.html"])
@pytest.mark.parametrize("width", [1400, 390, PAPER_PX])
def test_a_page_fits_and_is_whole(browser: Any, folder: Path, name: str, width: int) -> None:
    page = browser.new_page(viewport={"width": width, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    if width == PAPER_PX:
        page.emulate_media(media="print")
    amiss: list[str] = []
    asked: list[str] = []
    page.on("console", lambda message: amiss.append(message.text))
    page.on("pageerror", lambda error: amiss.append(str(error)))
    page.on("request", lambda request: asked.append(request.url))
    page.goto((folder / name).as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    if width != PAPER_PX:  # on paper nothing is folded
        page.evaluate("document.querySelectorAll('details').forEach((e) => e.open = true)")
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(OUTSIDE) == []
    assert page.evaluate(EMPTY) == []
    assert page.locator("figure").count() > (10 if name == "index.html" else 0)
    if width == PAPER_PX:  # paper does not scroll
        wide = "() => [...document.querySelectorAll('.scroll')].map((e) => e.scrollWidth)"
        assert max(page.evaluate(wide)) <= width
        assert page.pdf(format="A4").startswith(b"%PDF")
    assert [url for url in asked if url.startswith(("http", "file"))] == [page.url]
    assert amiss == []
    page.close()


LOWEST = """() => Math.max(...['h1', '#answer', '#failed'].map(
  (name) => document.querySelector(name).getBoundingClientRect().bottom))"""
INK = """() => [document.body, document.querySelector('#answer svg text')].map(
  (e, k) => getComputedStyle(e)[k ? 'fill' : 'backgroundColor'])"""
"""Colours of the ground and of a figure's text."""


@pytest.mark.long
def test_first_screen_answers_in_light_and_dark(browser: Any, folder: Path) -> None:
    grounds, inks = set(), set()
    for scheme in ("light", "dark"):
        page = browser.new_page(viewport={"width": 1400, "height": 900}, color_scheme=scheme)
        page.set_default_timeout(PATIENCE_MS)
        page.goto((folder / "index.html").as_uri())
        assert page.evaluate(LOWEST) <= 900
        ground, ink = page.evaluate(INK)
        assert ground != ink
        grounds.add(ground)
        inks.add(ink)
        first = page.locator("details.section").first
        first.locator("summary").focus()
        page.keyboard.press("Enter")
        assert first.locator("section").is_visible()
        page.close()
    assert len(grounds) == len(inks) == 2
