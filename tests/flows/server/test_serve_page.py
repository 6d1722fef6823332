"""The page of a service: behind the gate of its port, and a program of its own."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

from sliplab.flows.log import log_entries
from sliplab.flows.web.access import OPEN
from sliplab.storage.trials import control
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT
from tests.flows.server.serving import serving, until
from tests.flows.server.test_serve_access import EVIL, Service
from tests.flows.web.test_gate import STREAM, routes

pytestmark = pytest.mark.programs


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """`sliplab serve` with its own server."""
    folder = tmp_path_factory.mktemp("page")
    rig = ROOT / "rigs" / "rehearsal.yaml"
    with serving(folder / "store", rig, "page", None, folder / "serve.log") as page:
        found = Service(page, folder / "store")
        until("the page", lambda: found.ask("GET", "/log")[0] == 401)
        yield found


def entered(service: Service, role: str) -> dict[str, str]:
    """The headers of a browser that has opened a link."""
    link = urlsplit((service.store / ".prefect" / f"{role}-link").read_text().strip())
    status, headers, _ = service.ask("GET", f"{link.path}?{link.query}")
    assert status == 200
    assert parse_qs(link.query)["token"][0] not in headers["set-cookie"]
    return {"Cookie": headers["set-cookie"].partition(";")[0]}


def test_page_is_for_known_viewers_of_this_computer(service: Service, tmp_path: Path) -> None:
    reader = entered(service, "reader")
    for path, methods in routes(tmp_path / "store").items():
        if path.startswith(OPEN):
            continue
        assert service.ask("GET", path)[0] == 401, path
        if "GET" in methods and path != STREAM:
            assert service.ask("GET", path, **reader)[0] in {200, 404}, path
        assert service.ask("GET", path, **reader, Origin=EVIL)[0] == 403, path
        assert service.handshake(path, **reader) == 403, path
        assert service.ask("GET", path, **(reader | {"Host": "evil.example"}))[0] == 421, path


def test_link_changes_nothing_without_its_form(service: Service, tmp_path: Path) -> None:
    form = {"Content_Type": "application/x-www-form-urlencoded"}
    for role in ("reader", "operator"):
        known = entered(service, role)
        for path, methods in routes(tmp_path / role).items():
            if "POST" in methods:
                body = "who=Eve&why=x&text=x&csrf=guess"
                assert service.ask("POST", path, body, **known, **form)[0] == 403, path
    store = Store.open(service.store)
    assert (control.requests(store), log_entries(store)) == ([], [])


def test_links_are_no_way_into_prefects_interface(service: Service) -> None:
    operator = entered(service, "operator")
    assert service.ask("GET", "/api/admin/version", **operator)[0] == 401


def test_killed_page_takes_nothing_along_and_comes_again(service: Service) -> None:
    (pid,) = _pages(service.store)
    os.kill(pid, signal.SIGKILL)
    until("its end", lambda: service.ask("GET", "/log")[0] == 503)
    assert service.page.call("/flow_runs/filter", {}) == []
    until("another one", lambda: service.ask("GET", "/log")[0] == 401)
    assert _pages(service.store) != [pid]


def _pages(store: Path) -> list[int]:
    """The numbers of the programs that serve the page of a store."""
    found = []
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = line.read_bytes().split(b"\0")
        except OSError:  # it ended meanwhile
            continue
        if b"page" in words and str(store).encode() in words and b"--socket" in words:
            found.append(int(line.parent.name))
    return found
