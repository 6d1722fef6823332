"""Access to the server of `sliplab serve`: no foreign web page, nobody without the password."""

from __future__ import annotations

import base64
import json
import os
import re
import socket
import stat
import subprocess
import sys
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from sliplab.plugins.web.server import page_server
from sliplab.protocols import InputError
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.patching import loose
from tests.plugins.web.server.serving import EVIL, Service, serving, until
from tests.rigs.waiting import free_port

pytestmark = pytest.mark.programs

RUN = {"parameters": {"wanted": {"protocol": "pilot.yaml"}}, "state": {"type": "SCHEDULED"}}


def basic(password: str) -> str:
    """The header of a client that knows it."""
    return f"Basic {base64.b64encode(password.encode()).decode()}"


def test_a_foreign_page_gets_no_leave_to_ask(served: Service) -> None:
    asked = {"Method": "POST", "Headers": "content-type"}
    asked = {f"Access_Control_Request_{name}": value for name, value in asked.items()}
    status, headers, _ = served.ask("OPTIONS", "/api/deployments/filter", Origin=EVIL, **asked)
    assert (status, headers.get("access-control-allow-origin")) == (403, None)


@pytest.mark.parametrize("kind", ["application/json", "text/plain"])
@pytest.mark.parametrize("origin", [EVIL, "null", "http://127.0.0.1:1", "https://localhost"])
def test_a_foreign_page_is_answered_nothing(served: Service, origin: str, kind: str) -> None:
    known = basic(served.page.password)  # even with the password
    before, deployment = served.runs(), served.page.deployment("collect")["id"]
    run = f"/api/deployments/{deployment}/create_flow_run"
    for path, body in (("/api/deployments/filter", "{}"), (run, json.dumps(RUN))):
        status, headers, text = served.ask(
            "POST", path, body, Origin=origin, Content_Type=kind, Authorization=known
        )
        assert (status, headers.get("access-control-allow-origin")) == (403, None), text
    path, sent = f"/api/deployments/{deployment}", {"Origin": origin, "Authorization": known}
    for method in ("GET", "PATCH", "DELETE"):
        assert served.ask(method, path, **sent)[0] == 403
    assert served.runs() == before  # nothing was started
    assert served.page.deployment("collect")["id"] == deployment


def test_a_foreign_host_name_is_no_way_in(served: Service) -> None:
    known = basic(served.page.password)
    for host in ("evil.example", f"evil.example:{served.port}", "127.0.0.1:1", "localhost", ""):
        for path in ("/", "/ui-settings", "/api/health", "/api/admin/version"):
            assert served.ask("GET", path, Host=host, Authorization=known)[0] == 421, (host, path)
    for name in ("127.0.0.1", "localhost", "LOCALHOST", "[::1]"):
        host = f"{name}:{served.port}"
        own = {"Host": host, "Origin": f"http://{host.lower()}", "Authorization": known}
        assert served.ask("GET", "/api/admin/version", **own)[0] == 200, name
    with socket.create_connection(("127.0.0.1", served.port), timeout=30) as line:
        line.sendall(f"GET /api/health HTTP/1.1\r\nHost: {served.host}\r\nHost: x\r\n\r\n".encode())
        assert line.recv(100).split()[1] in {b"400", b"421"}


def test_nobody_without_the_password(served: Service) -> None:
    before, deployment = served.runs(), served.page.deployment("collect")["id"]
    for given in ({}, {"Authorization": basic("sliplab:guess")}, {"Authorization": "Basic \xff"}):
        for method, path, body in (
            ("POST", "/api/deployments/filter", "{}"),
            ("POST", f"/api/deployments/{deployment}/create_flow_run", json.dumps(RUN)),
            ("GET", f"/api/deployments/{deployment}", None),
            ("GET", "/api/csrf-token?client=1", None),
            ("GET", "/api/openapi.json", None),
        ):
            kind = {"Content_Type": "application/json"} if body else {}
            assert served.ask(method, path, body, **kind, **given)[0] in {401, 403}, path
    assert served.runs() == before


def test_every_route_of_prefect_is_closed(served: Service) -> None:
    """By its own list: a new version's routes are tried, too."""
    known = basic(served.page.password)
    _, _, text = served.ask("GET", "/api/openapi.json", Authorization=known)
    found = json.loads(text)["paths"]
    assert len(found) > 50
    for route, methods in found.items():
        path = re.sub(r"{\w+}", "x", route if route.startswith("/api") else f"/api{route}")
        for method in methods:
            asked = method.upper(), path, None if method == "get" else "{}"
            kind = {"Content_Type": "application/json"}
            if path not in PUBLIC:
                assert served.ask(*asked, **kind)[0] in {401, 403}, asked
            sent = {**kind, "Authorization": known}
            assert served.ask(*asked, **sent, Origin=EVIL)[0] == 403, asked
            assert served.ask(*asked, **(sent | {"Host": "evil.example"}))[0] == 421, asked


def test_a_change_needs_a_token_of_its_own(served: Service) -> None:
    known = {"Authorization": basic(served.page.password), "Content_Type": "application/json"}
    status, _, text = served.ask("POST", "/api/deployments/filter", "{}", **known)
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
def test_websockets_are_as_closed(served: Service, path: str) -> None:
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    path = path if served.handshake(path) == 101 else path.replace("pools", "pool")
    assert served.handshake(path, Origin=EVIL) == 403
    assert served.handshake(path, Host=f"evil.example:{served.port}") == 403
    for message in ({"type": "auth", "token": "sliplab:guess"}, {"type": "auth"}, {"type": "x"}):
        with connect(f"ws://{served.host}{path}", subprotocols=loose(["prefect"])) as line:
            line.send(json.dumps(message))
            with pytest.raises(ConnectionClosed):
                line.recv(timeout=30)
    with connect(f"ws://{served.host}{path}", subprotocols=loose(["prefect"])) as line:
        line.send(json.dumps({"type": "auth", "token": served.page.password}))
        assert json.loads(line.recv(timeout=30))["type"] == "auth_success"


def test_the_password_is_its_users_alone(served: Service) -> None:
    file = served.store / ".prefect" / "page-password"
    found = file.stat()
    assert (stat.S_IMODE(found.st_mode), found.st_uid) == (0o600, os.getuid())
    password = file.read_text().strip()
    assert password == served.page.password
    reported = served.page.log.read_text()
    assert str(file) in reported
    secret = password.partition(":")[2]
    assert len(secret) > 40
    assert secret not in reported
    for path in (path for path in served.store.rglob("*") if path.is_file() and path != file):
        assert secret.encode() not in path.read_bytes(), path
    for line in Path("/proc").glob("[0-9]*/cmdline"):
        assert secret.encode() not in _bytes(line), line


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:  # a process that ended meanwhile
        return b""


def test_its_page_is_framed_by_nobody(served: Service) -> None:
    status, headers, text = served.ask("GET", "/v2/", Accept="text/html")
    assert (status, "<html" in text.lower()) == (200, True)
    assert headers["x-frame-options"] == "DENY"
    status, _, text = served.ask("GET", "/ui-settings")
    settings: dict[str, Any] = json.loads(text)
    assert (status, settings["auth"], settings["csrf_enabled"]) == (200, "BASIC", True)
    assert settings["api_url"] == f"http://{served.host}/api"


def test_every_run_knows_the_password_by_itself(served: Service) -> None:
    run = served.page.run("label")
    assert "id" in run, run
    ended = served.page.ended(run["id"])
    assert ended["type"] == "FAILED", ended  # the store has no campaign, and the run could say so
    assert "holds no campaign" in ended["message"] or "no campaign" in ended["message"]
    assert TrialStore.open(served.store).campaigns() == []


def test_a_run_is_answered_nothing_of_files_elsewhere(served: Service) -> None:
    run = served.page.run("collect", protocol="/proc/self/environ")
    ended = served.page.ended(run["id"])
    assert ended["type"] == "FAILED"
    assert "protocol = /proc/self/environ: must be a file .yaml or .yml below " in ended["message"]


@pytest.mark.long
def test_a_permanent_server_needs_a_password_too(served: Service, tmp_path: Path) -> None:
    page_server.refuse_open(served.page.url)
    port = free_port()
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
