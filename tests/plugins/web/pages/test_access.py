"""Access to the web application: links, cookies, roles, tokens of forms."""

from __future__ import annotations

from pathlib import Path

import pytest
from starlette.testclient import TestClient

from sliplab.flows.log import log_entries
from sliplab.plugins.web.pages.access import Access
from sliplab.plugins.web.pages.app import application
from sliplab.plugins.web.pages.web import Web
from sliplab.plugins.web.server.links import Role
from sliplab.storage.trials.store import Store

ACCESS = Access({"operator": "o" * 40, "reader": "r" * 40})


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store.create(tmp_path / "store")


def client(store: Store, role: Role | None = None) -> TestClient:
    """A browser that opened the link of a role."""
    found = TestClient(application(Web(store, ACCESS)), follow_redirects=False)
    if role is not None:
        assert found.get(f"/enter?token={ACCESS.tokens[role]}").status_code == 200
    return found


def csrf(found: TestClient) -> str:
    """The token of the forms of a browser."""
    viewer = ACCESS.viewer(dict(found.cookies))
    assert viewer is not None
    return viewer.csrf


def test_cookie_is_hidden_from_scripts_and_other_sites(store: Store) -> None:
    answer = client(store).get(f"/enter?token={ACCESS.tokens['reader']}")
    header = answer.headers["set-cookie"]
    assert "HttpOnly" in header
    assert "SameSite=Strict" in header
    assert ACCESS.tokens["reader"] not in header
    assert client(store).get("/enter?token=guess").status_code == 403


def test_forged_cookie_is_refused(store: Store) -> None:
    reader = client(store, "reader")
    value = reader.cookies["sliplab"]
    forged = TestClient(application(Web(store, ACCESS)))
    forged.cookies.set("sliplab", value.replace("reader", "operator"))
    assert forged.get("/log").status_code == 401


def test_operator_needs_the_forms_token(store: Store) -> None:
    operator = client(store, "operator")
    assert operator.post("/log", data={"text": "hello"}).status_code == 403
    assert operator.post("/log", data={"text": "hello", "csrf": "x"}).status_code == 403
    assert log_entries(store) == []
    answer = operator.post("/log", data={"text": "new skin", "csrf": csrf(operator)})
    assert (answer.status_code, answer.headers["location"]) == (303, "/log")
    assert [entry.text for entry in log_entries(store)] == ["new skin"]
    assert "new skin" in operator.get("/log").text
