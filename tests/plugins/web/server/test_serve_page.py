"""The page of a service: behind the gate of its port, and a program of its own."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from sliplab.flows.log import log_entries
from sliplab.plugins.web.pages.access import OPEN
from sliplab.storage.trials import control
from sliplab.storage.trials.store import TrialStore
from tests.plugins.web.pages.test_gate import STREAM, routes
from tests.plugins.web.server.serving import EVIL, Service, processes, until

pytestmark = pytest.mark.programs


def entered(served: Service, role: str) -> dict[str, str]:
    """The headers of a browser that has opened a link."""
    link = urlsplit((served.store / ".prefect" / f"{role}-link").read_text().strip())
    status, headers, _ = served.ask("GET", f"{link.path}?{link.query}")
    assert status == 200
    assert parse_qs(link.query)["token"][0] not in headers["set-cookie"]
    return {"Cookie": headers["set-cookie"].partition(";")[0]}


def test_page_is_for_known_viewers_of_this_computer(served: Service, tmp_path: Path) -> None:
    reader = entered(served, "reader")
    for path, methods in routes(tmp_path / "store").items():
        if path.startswith(OPEN):
            continue
        assert served.ask("GET", path)[0] == 401, path
        if "GET" in methods and path != STREAM:
            assert served.ask("GET", path, **reader)[0] in {200, 404}, path
        assert served.ask("GET", path, **reader, Origin=EVIL)[0] == 403, path
        assert served.handshake(path, **reader) == 403, path
        assert served.ask("GET", path, **(reader | {"Host": "evil.example"}))[0] == 421, path


def test_link_changes_nothing_without_its_form(served: Service, tmp_path: Path) -> None:
    form = {"Content_Type": "application/x-www-form-urlencoded"}
    store = TrialStore.open(served.store)
    before = control.requests(store), log_entries(store)
    for role in ("reader", "operator"):
        known = entered(served, role)
        for path, methods in routes(tmp_path / role).items():
            if "POST" in methods:
                body = "who=Eve&why=x&text=x&csrf=guess"
                assert served.ask("POST", path, body, **known, **form)[0] == 403, path
    assert (control.requests(store), log_entries(store)) == before


def test_links_are_no_way_into_prefects_interface(served: Service) -> None:
    operator = entered(served, "operator")
    assert served.ask("GET", "/api/admin/version", **operator)[0] == 401


def test_killed_page_takes_nothing_along_and_comes_again(served: Service) -> None:
    (pid,), before = _pages(served.store), served.runs()
    os.kill(pid, signal.SIGKILL)
    until("its end", lambda: served.ask("GET", "/log")[0] == 503)
    assert served.runs() == before
    until("another one", lambda: served.ask("GET", "/log")[0] == 401)
    assert _pages(served.store) != [pid]


def _pages(store: Path) -> list[int]:
    """The numbers of the programs that serve the page of a store."""
    return processes("page", str(store), "--socket")
