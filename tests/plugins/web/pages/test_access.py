"""Access to the web application: links, cookies, roles, tokens of forms."""

from __future__ import annotations

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from sliplab.flows.log import log_entries
from sliplab.plugins.web.pages.app import application
from sliplab.plugins.web.pages.web import Web
from sliplab.storage.trials.store import TrialStore
from tests.plugins.web.pages.opened import ACCESS, csrf, opened


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    return TrialStore.create(tmp_path / "store")


def test_cookie_is_hidden_from_scripts_and_other_sites(store: TrialStore) -> None:
    answer = opened(store, role=None).get(f"/enter?token={ACCESS.tokens['reader']}")
    header = answer.headers["set-cookie"]
    assert "HttpOnly" in header
    assert "SameSite=Strict" in header
    assert ACCESS.tokens["reader"] not in header
    assert opened(store, role=None).get("/enter?token=guess").status_code == 403


def test_forged_cookie_is_refused(store: TrialStore) -> None:
    reader = opened(store, role="reader")
    value = reader.cookies["sliplab"]
    forged = TestClient(application(Web(store, ACCESS)))
    forged.cookies.set("sliplab", value.replace("reader", "operator"))
    assert forged.get("/log").status_code == 401


def test_operator_needs_the_forms_token(store: TrialStore) -> None:
    operator = opened(store)
    assert operator.post("/log", data={"text": "hello"}).status_code == 403
    assert operator.post("/log", data={"text": "hello", "csrf": "x"}).status_code == 403
    assert log_entries(store) == []
    answer = operator.post("/log", data={"text": "new skin", "csrf": csrf(operator)})
    assert (answer.status_code, answer.headers["location"]) == (303, "/log")
    assert [entry.text for entry in log_entries(store)] == ["new skin"]
    assert "new skin" in operator.get("/log").text
