"""The gate in front of every route of the application, taken from its own list."""

from __future__ import annotations

import hashlib
from functools import partial
from itertools import cycle
from pathlib import Path

import pytest
from starlette.routing import Mount, Route
from starlette.websockets import WebSocketDisconnect

from sliplab.plugins.web.pages.access import OPEN, Access
from sliplab.plugins.web.pages.app import application
from sliplab.plugins.web.pages.web import Web
from sliplab.storage.trials.store import TrialStore
from tests.plugins.web.pages.opened import ACCESS, csrf, opened
from tests.storage.trial_files import campaign, commit

PORT = 4300
OWN = f"http://127.0.0.1:{PORT}"
browser = partial(opened, port=PORT)
CHANGES = ("POST", "PUT", "PATCH", "DELETE")
STREAM = "/live"
"""It does not end: `test_live` reads it."""


def routes(root: Path) -> dict[str, set[str]]:
    """The methods of every path, with the trial of `store` in place of names; and of no path."""
    found: dict[str, set[str]] = {"/nowhere": set()}
    for route in application(Web(TrialStore.create(root), ACCESS)).routes:
        if isinstance(route, Mount):
            found.setdefault(f"{route.path}/style.css", set()).add("GET")
            continue
        assert isinstance(route, Route), f"no gate is tested for {route}"
        path = route.path.replace("{campaign}", "tiny").replace("{trial}", "a")
        path = path.replace("{path:path}", "index.html")
        assert "{" not in path, f"no value is known for {path}"
        found.setdefault(path, set()).update(route.methods or ())
    return found


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    return routes(tmp_path_factory.mktemp("routes") / "store")


@pytest.fixture
def store(tmp_path: Path) -> TrialStore:
    commit(campaign(tmp_path / "store", "tiny"), "a")
    return TrialStore.open(tmp_path / "store")


def contents(store: TrialStore) -> dict[str, str]:
    """A digest of every file of a store but the catalogue, which is made of the others."""
    return {
        str(path.relative_to(store.folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(store.folder.rglob("*"))
        if path.is_file() and path.parent.name != "catalogue"
    }


def test_every_subject_is_in_the_table(table: dict[str, set[str]]) -> None:
    posted = {path for path, methods in table.items() if "POST" in methods}
    actions = {"pause", "resume", "stop", "skip", "again", "collect"}
    assert posted >= {f"/control/{action}" for action in actions} | {"/log", "/review/decision"}
    assert {STREAM, "/", "/trials", "/trials/tiny/a/files", "/review", "/schedules"} <= set(table)


def test_foreign_page_and_foreign_name_get_nothing(
    store: TrialStore, table: dict[str, set[str]]
) -> None:
    """Not even with the operator's cookie and the form's token, by any method.

    Each path and method has one of the origins and one of the names, in turn.
    """
    origins = cycle(("http://evil.example", "null", "http://127.0.0.1:4301", ""))
    hosts = cycle(("evil.example", "127.0.0.1", "127.0.0.1:1", "localhost", ""))
    operator = browser(store)
    known = {"x-csrf-token": csrf(operator, OWN)}
    before = contents(store)
    for path in table:
        for method in ("GET", "HEAD", "OPTIONS", *CHANGES):
            origin, host = next(origins), next(hosts)
            answer = operator.request(method, path, headers={**known, "origin": origin})
            assert answer.status_code == 403, (method, path, origin)
            answer = operator.request(method, path, headers={**known, "host": host})
            assert answer.status_code == 421, (method, path, host)
    assert contents(store) == before


def test_without_a_link_there_is_no_page(store: TrialStore, table: dict[str, set[str]]) -> None:
    stranger, before = browser(store, role=None), contents(store)
    forged = Access({"operator": "x" * 40, "reader": "y" * 40}).cookie("operator")
    for cookie in ("", forged, "operator..", "operator.a.b"):
        stranger.cookies.clear()
        if cookie:
            stranger.cookies.set(f"sliplab-{PORT}", cookie)
        for path in table:
            for method in ("GET", *CHANGES):
                answer = stranger.request(method, path)
                if path.startswith(OPEN):
                    assert answer.status_code in {200, 403, 405}, (method, path)
                else:
                    assert answer.status_code == 401, (method, path, cookie)
                assert str(store.folder) not in answer.text
    assert contents(store) == before


def test_every_websocket_is_refused(store: TrialStore, table: dict[str, set[str]]) -> None:
    operator = browser(store)
    for path in table:
        for origin in ({}, {"origin": "http://evil.example"}):
            with (
                pytest.raises(WebSocketDisconnect) as refused,
                operator.websocket_connect(path, headers={"host": f"127.0.0.1:{PORT}", **origin}),
            ):
                pass
            assert refused.value.code == 1008, path


def test_reader_can_do_nothing(store: TrialStore, table: dict[str, set[str]]) -> None:
    """Neither by a form's token of the reader's own, nor by the operator's; pages have no form."""
    reader, operator = (
        browser(store, role="reader"),
        browser(store),
    )
    before = contents(store)
    fields = {"who": "Eve", "why": "x", "text": "x", "trials": "a", "protocol": "pilot.yaml"}
    for path in table:
        if path.startswith(OPEN):
            continue
        for method in CHANGES:
            for token in (csrf(reader, OWN), csrf(operator, OWN)):
                sent = {"csrf": token, **fields}
                answer = reader.request(
                    method, path, data=sent, headers={"x-csrf-token": token, "origin": OWN}
                )
                assert answer.status_code == 403, (method, path)
        if path != STREAM and "GET" in table[path]:
            answer = reader.get(path)
            assert answer.status_code in {200, 404}, path
            assert 'method="post"' not in answer.text, path
            assert csrf(reader, OWN) not in answer.text, path
    assert contents(store) == before


def test_operator_changes_nothing_without_the_forms_token(
    store: TrialStore, table: dict[str, set[str]]
) -> None:
    operator, other = (
        browser(store),
        browser(store),
    )
    before = contents(store)
    fields = {"who": "Eve", "why": "x", "text": "x", "trials": "a"}
    for path in table:
        if path.startswith(OPEN):
            continue
        for method in CHANGES:
            for token in ("", "guess", csrf(other, OWN)):
                sent = {"csrf": token, **fields}
                assert operator.request(method, path, data=sent).status_code == 403, (method, path)
            answer = operator.request(method, path, content=b"x" * 2_000_000)
            assert answer.status_code == 413, (method, path)
    assert contents(store) == before


def test_looking_changes_no_byte(store: TrialStore, table: dict[str, set[str]]) -> None:
    operator = browser(store)
    before = contents(store)
    for path, methods in table.items():
        if path != STREAM and "GET" in methods:
            for method in ("GET", "HEAD"):
                operator.request(method, path)
    assert contents(store) == before
