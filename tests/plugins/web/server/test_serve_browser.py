"""Prefect's page of a service in a real browser: a person logs in, a foreign page gets nothing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.flows.browser import PATIENCE_MS, expect, launched, needs_browser
from tests.plugins.web.server.serving import Service

pytestmark = [needs_browser, pytest.mark.programs]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with launched() as found:
        yield found


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("localhost", marks=pytest.mark.long)])
def test_a_person_logs_in_and_runs_something(served: Service, browser: Any, host: str) -> None:
    page = served.page
    with browser.new_context() as context:
        tab = context.new_page()
        tab.set_default_timeout(PATIENCE_MS)
        outside: list[str] = []  # what the browser tried to look up, and was not kept from
        tab.on(
            "requestfailed",
            lambda r: outside.append(r.url) if "ERR_NAME_NOT_RESOLVED" in r.failure else None,
        )
        root = page.url.removesuffix("/api").replace("127.0.0.1", host)
        tab.goto(f"{root}/v2/")
        box = tab.get_by_role("textbox")
        box.fill("sliplab:guess")
        box.press("Enter")
        expect(tab.get_by_role("link", name="Deployments")).to_have_count(0)
        box.fill(page.password)
        box.press("Enter")
        expect(tab.get_by_role("link", name="Deployments").first).to_be_visible()
        before = served.runs()
        tab.goto(f"{root}/v2/deployments/deployment/{page.deployment('label')['id']}")
        for _ in range(4):  # SQLite may be written to meanwhile (503): a person presses again
            with tab.expect_response(lambda r: r.url.endswith("/create_flow_run")) as answer:
                tab.get_by_role("button", name="Run", exact=True).click()
                tab.get_by_role("menuitem", name="Quick run").click()
            if answer.value.status != 503:
                break
        assert answer.value.status == 201
        assert served.runs() == before + 1
        assert outside == []


def test_a_foreign_page_starts_nothing(served: Service, browser: Any) -> None:
    page = served.page
    before = served.runs()
    run = f"{page.url}/deployments/{page.deployment('label')['id']}/create_flow_run"
    script = """async (url) => {
        const said = [];
        for (const kind of ["application/json", "text/plain"])
            for (const mode of ["cors", "no-cors"])
                try {
                    const headers = {"content-type": kind}, body = "{}";
                    said.push((await fetch(url, {method: "POST", mode, headers, body})).status);
                } catch (error) { said.push("refused"); }
        return said; }"""
    with browser.new_context() as context:
        tab = context.new_page()
        tab.route(
            "http://evil.example/*",
            lambda route: route.fulfill(body="<html></html>", content_type="text/html"),
        )
        tab.goto("http://evil.example/")
        assert set(tab.evaluate(script, run)) <= {"refused", 0}  # 0: an answer that is not shown
    assert served.runs() == before
