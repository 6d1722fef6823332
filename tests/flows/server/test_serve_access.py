"""Access to the server of `sliplab serve`: no foreign web page, nobody without the password."""

from __future__ import annotations

import base64
import http.client
import json
import os
import re
import socket
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest

from sliplab.flows.server import page_server
from sliplab.protocols import InputError
from sliplab.storage.trials.store import Store
from tests.conftest import ROOT
from tests.flows.server.serving import Page, serving, until

pytestmark = pytest.mark.programs

EVIL = "http://evil.example"
RUN = {"parameters": {"wanted": {"protocol": "pilot.yaml"}}, "state": {"type": "SCHEDULED"}}


class Service:
    """A service of its own process with its own server, as a stranger reaches it: raw HTTP."""

    def __init__(self, page: Page, store: Path) -> None:
        self.page, self.store = page, store
        self.port = urlsplit(page.url).port or 0
        self.host = f"127.0.0.1:{self.port}"

    def ask(
        self, method: str, path: str, body: str | None = None, **headers: str
    ) -> tuple[int, dict[str, str], str]:
        """Status, headers in lower case, and text of one answer; names with `_` for `-`."""
        line = http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)
        try:
            sent = {"Host": self.host, **{k.replace("_", "-"): v for k, v in headers.items()}}
            line.request(method, path, body, sent)
            answer = line.getresponse()
            text = answer.read().decode(errors="replace")
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, text
        finally:
            line.close()

    def handshake(self, path: str, **headers: str) -> int:
        """The status that answers a websocket's first request."""
        sent = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13"}
        key = base64.b64encode(b"0" * 16).decode()
        sent |= {"Sec_WebSocket_Key": key, "Sec_WebSocket_Protocol": "prefect"}
        return self.ask("GET", path, **sent, **headers)[0]


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """`sliplab serve` with its own server."""
    folder = tmp_path_factory.mktemp("access")
    rig = ROOT / "rigs" / "rehearsal.yaml"
    with serving(folder / "store", rig, "access", None, folder / "serve.log") as page:
        yield Service(page, folder / "store")


def basic(password: str) -> str:
    """The header of a client that knows it."""
    return f"Basic {base64.b64encode(password.encode()).decode()}"


def test_a_foreign_page_gets_no_leave_to_ask(service: Service) -> None:
    asked = {"Method": "POST", "Headers": "content-type"}
    asked = {f"Access_Control_Request_{name}": value for name, value in asked.items()}
    status, headers, _ = service.ask("OPTIONS", "/api/deployments/filter", Origin=EVIL, **asked)
    assert (status, headers.get("access-control-allow-origin")) == (403, None)


@pytest.mark.parametrize("kind", ["application/json", "text/plain"])
@pytest.mark.parametrize("origin", [EVIL, "null", "http://127.0.0.1:1", "https://localhost"])
def test_a_foreign_page_is_answered_nothing(service: Service, origin: str, kind: str) -> None:
    known = basic(service.page.password)  # even with the password
    deployment = service.page.deployment("collect")["id"]
    run = f"/api/deployments/{deployment}/create_flow_run"
    for path, body in (("/api/deployments/filter", "{}"), (run, json.dumps(RUN))):
        status, headers, text = service.ask(
            "POST", path, body, Origin=origin, Content_Type=kind, Authorization=known
        )
        assert (status, headers.get("access-control-allow-origin")) == (403, None), text
    path, sent = f"/api/deployments/{deployment}", {"Origin": origin, "Authorization": known}
    for method in ("GET", "PATCH", "DELETE"):
        assert service.ask(method, path, **sent)[0] == 403
    assert service.page.call("/flow_runs/filter", {}) == []  # nothing was started
    assert service.page.deployment("collect")["id"] == deployment


def test_a_foreign_host_name_is_no_way_in(service: Service) -> None:
    known = basic(service.page.password)
    for host in ("evil.example", f"evil.example:{service.port}", "127.0.0.1:1", "localhost", ""):
        for path in ("/", "/ui-settings", "/api/health", "/api/admin/version"):
            assert service.ask("GET", path, Host=host, Authorization=known)[0] == 421, (host, path)
    for name in ("127.0.0.1", "localhost", "LOCALHOST", "[::1]"):
        host = f"{name}:{service.port}"
        own = {"Host": host, "Origin": f"http://{host.lower()}", "Authorization": known}
        assert service.ask("GET", "/api/admin/version", **own)[0] == 200, name
    with socket.create_connection(("127.0.0.1", service.port), timeout=30) as line:
        line.sendall(
            f"GET /api/health HTTP/1.1\r\nHost: {service.host}\r\nHost: x\r\n\r\n".encode()
        )
        assert line.recv(100).split()[1] in {b"400", b"421"}


def test_nobody_without_the_password(service: Service) -> None:
    deployment = service.page.deployment("collect")["id"]
    for given in ({}, {"Authorization": basic("sliplab:guess")}, {"Authorization": "Basic \xff"}):
        for method, path, body in (
            ("POST", "/api/deployments/filter", "{}"),
            ("POST", f"/api/deployments/{deployment}/create_flow_run", json.dumps(RUN)),
            ("GET", f"/api/deployments/{deployment}", None),
            ("GET", "/api/csrf-token?client=1", None),
            ("GET", "/api/openapi.json", None),
        ):
            kind = {"Content_Type": "application/json"} if body else {}
            assert service.ask(method, path, body, **kind, **given)[0] in {401, 403}, path
    assert service.page.call("/flow_runs/filter", {}) == []


def test_every_route_of_prefect_is_closed(service: Service) -> None:
    """By its own list: a new version's routes are tried, too."""
    known = basic(service.page.password)
    _, _, text = service.ask("GET", "/api/openapi.json", Authorization=known)
    found = json.loads(text)["paths"]
    assert len(found) > 50
    for route, methods in found.items():
        path = re.sub(r"{\w+}", "x", route if route.startswith("/api") else f"/api{route}")
        for method in methods:
            asked = method.upper(), path, None if method == "get" else "{}"
            kind = {"Content_Type": "application/json"}
            if path not in PUBLIC:
                assert service.ask(*asked, **kind)[0] in {401, 403}, asked
            sent = {**kind, "Authorization": known}
            assert service.ask(*asked, **sent, Origin=EVIL)[0] == 403, asked
            assert service.ask(*asked, **(sent | {"Host": "evil.example"}))[0] == 421, asked


def test_a_change_needs_a_token_of_its_own(service: Service) -> None:
    known = {"Authorization": basic(service.page.password), "Content_Type": "application/json"}
    status, _, text = service.ask("POST", "/api/deployments/filter", "{}", **known)
    assert (status, "Missing CSRF token" in text) == (403, True)


PUBLIC = ("/api/health", "/api/ready")
"""Paths that need no password."""
SOCKETS = (
    "/api/events/in",
    "/api/events/out",
    "/api/logs/out",
    "/api/task_runs/subscriptions/scheduled",
    "/api/work_pools/pool/workers/connect",
)


@pytest.mark.parametrize("path", SOCKETS)
def test_websockets_are_as_closed(service: Service, path: str) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    path = path if service.handshake(path) == 101 else path.replace("pools", "pool")
    assert service.handshake(path, Origin=EVIL) == 403
    assert service.handshake(path, Host=f"evil.example:{service.port}") == 403
    for message in ({"type": "auth", "token": "sliplab:guess"}, {"type": "auth"}, {"type": "x"}):
        with connect(f"ws://{service.host}{path}", subprotocols=["prefect"]) as line:  # type: ignore[list-item]
            line.send(json.dumps(message))
            with pytest.raises(ConnectionClosed):
                line.recv(timeout=30)
    with connect(f"ws://{service.host}{path}", subprotocols=["prefect"]) as line:  # type: ignore[list-item]
        line.send(json.dumps({"type": "auth", "token": service.page.password}))
        assert json.loads(line.recv(timeout=30))["type"] == "auth_success"


def test_the_password_is_its_users_alone(service: Service) -> None:
    file = service.store / ".prefect" / "page-password"
    found = file.stat()
    assert (stat.S_IMODE(found.st_mode), found.st_uid) == (0o600, os.getuid())
    password = file.read_text().strip()
    assert password == service.page.password
    reported = service.page.log.read_text()
    assert str(file) in reported
    secret = password.partition(":")[2]
    assert len(secret) > 40
    assert secret not in reported
    for path in (path for path in service.store.rglob("*") if path.is_file() and path != file):
        assert secret.encode() not in path.read_bytes(), path
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        assert secret.encode() not in _bytes(line), line


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:  # a process that ended meanwhile
        return b""


def test_its_page_is_framed_by_nobody(service: Service) -> None:
    status, headers, text = service.ask("GET", "/v2/", Accept="text/html")
    assert (status, "<html" in text.lower()) == (200, True)
    assert headers["x-frame-options"] == "DENY"
    status, _, text = service.ask("GET", "/ui-settings")
    settings: dict[str, Any] = json.loads(text)
    assert (status, settings["auth"], settings["csrf_enabled"]) == (200, "BASIC", True)
    assert settings["api_url"] == f"http://{service.host}/api"


def test_every_run_knows_the_password_by_itself(service: Service) -> None:
    run = service.page.run("label")
    assert "id" in run, run
    ended = service.page.ended(run["id"])
    assert ended["type"] == "FAILED", ended  # the store has no campaign, and the run could say so
    assert "holds no campaign" in ended["message"] or "no campaign" in ended["message"]
    assert Store.open(service.store).campaigns() == []


def test_a_run_is_answered_nothing_of_files_elsewhere(service: Service) -> None:
    run = service.page.run("collect", protocol="/proc/self/environ")
    ended = service.page.ended(run["id"])
    assert ended["type"] == "FAILED"
    assert "protocol = /proc/self/environ: must be a file .yaml or .yml below " in ended["message"]


def test_a_permanent_server_needs_a_password_too(service: Service, tmp_path: Path) -> None:
    page_server.refuse_open(service.page.url)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    page_server.refuse_open(f"http://127.0.0.1:{port}/api")  # nobody there: Prefect says so
    own = {"PREFECT_HOME": str(tmp_path), "PREFECT__SERVER_EPHEMERAL": "1"}
    factory = ("--factory", "prefect.server.api.server:create_app")
    process = subprocess.Popen(
        [sys.executable, "-m", "uvicorn", *factory, "--port", str(port), "--log-level", "error"],
        env={**os.environ, **own},
    )
    try:
        health = f"http://127.0.0.1:{port}/api/health"
        until("an open server", lambda: process.poll() is not None or _answers(health))
        with pytest.raises(InputError, match=r"PREFECT_API_URL = .* has no password"):
            page_server.refuse_open(f"http://anna:secret@127.0.0.1:{port}/api")
    finally:
        process.kill()
        process.wait(30)


def test_a_server_that_is_silent_is_not_taken_for_one_with_a_password(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(page_server, "ANSWER_S", 0.2)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(InputError, match=r"did not answer in 0\.2 s, so whether it asks"):
            page_server.refuse_open(f"http://127.0.0.1:{port}/api")


def _answers(url: str) -> bool:
    try:
        with urlopen(url, timeout=5) as answer:
            return bool(answer.status == 200)
    except OSError:
        return False


@pytest.mark.parametrize("before", ["readable", "link", "empty", "folder"])
def test_a_password_that_others_could_know_is_made_anew(before: str, tmp_path: Path) -> None:
    path = tmp_path / page_server.PASSWORD
    first = page_server.page_password(tmp_path)
    assert page_server.page_password(tmp_path) == first
    if before == "readable":
        path.chmod(0o640)
    elif before == "link":
        path.rename(tmp_path / "moved")
        path.symlink_to("moved")
    elif before == "empty":
        path.write_text("")
    else:
        path.unlink()
        path.mkdir()
        with pytest.raises(InputError, match="cannot be written"):
            page_server.page_password(tmp_path)
        return
    second = page_server.page_password(tmp_path)
    assert second != first
    assert (path.read_text().strip(), path.is_symlink()) == (second, False)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


@pytest.mark.long
def test_a_service_that_is_ended_at_once_ends(tmp_path: Path) -> None:
    rig = ROOT / "rigs" / "rehearsal.yaml"
    with serving(tmp_path / "store", rig, "short", None, tmp_path / "serve.log") as page:
        assert page.password
