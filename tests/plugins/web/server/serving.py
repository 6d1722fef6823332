"""A service and a Prefect server as tests meet them: from outside, over HTTP."""

from __future__ import annotations

import base64
import gc
import http.client
import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpcore

from tests.conftest import ROOT

LIMIT_S = 120.0
BUSY_S = 10.0
EVIL = "http://evil.example"
FINAL = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}


def until(
    what: str, found: Callable[[], Any], limit_s: float = LIMIT_S, pause_s: float = 0.05
) -> Any:
    """Return the result of `found` as soon as it is truthy."""
    end = time.monotonic() + limit_s
    pause = threading.Event()
    while not (answer := found()):
        assert time.monotonic() < end, f"waited {limit_s:g} s for {what}"
        pause.wait(pause_s)
    return answer


def processes(*words: str) -> list[int]:
    """The numbers of the processes with some words among those of their command."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):  # it has ended meanwhile
            if {*words} <= {*path.read_text(errors="replace").split("\0")}:
                found.append(int(path.parent.name))
    return found


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Leave garbage where `clients` sees it, while the block runs."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


def clients() -> int:
    """HTTP clients in this process, those that are garbage included.

    Each has a copy of the certificates, 0.7 MB; the tests share one.
    """
    return sum(isinstance(item, httpcore.AsyncConnectionPool) for item in gc.get_objects())


def access(url: str, password: str) -> dict[str, str]:
    """The headers of a client that has the password, with a token for changes."""
    known = {"Authorization": f"Basic {base64.b64encode(password.encode()).decode()}"}
    client = str(uuid.uuid4())
    request = urllib.request.Request(f"{url}/csrf-token?client={client}", headers=known)
    with urllib.request.urlopen(request, timeout=30) as answer:
        token = json.loads(answer.read())["token"]
    return {**known, "Prefect-Csrf-Client": client, "Prefect-Csrf-Token": token}


class Page:
    """A user's actions on Prefect's page."""

    def __init__(self, url: str, password: str, name: str, log: Path = Path()) -> None:
        self.url, self.password, self._name, self.log = url, password, name, log
        self._headers: dict[str, str] = {}

    def call(self, path: str, data: Any = None) -> Any:
        """Return the server's answer, or ``{"status": ..., "detail": ...}`` of its refusal.

        A server whose SQLite file is being written to answers 503: Prefect's own clients, and this
        one, ask again for some seconds.
        """
        if not self._headers:
            self._headers = access(self.url, self.password)
        body = None if data is None else json.dumps(data).encode()
        headers = {"content-type": "application/json", **self._headers}
        request = urllib.request.Request(f"{self.url}{path}", body, headers)
        end, pause = time.monotonic() + BUSY_S, threading.Event()
        while True:
            try:
                with urllib.request.urlopen(request, timeout=30) as answer:
                    return json.loads(answer.read() or b"null")
            except urllib.error.HTTPError as error:
                if error.code != 503 or time.monotonic() > end:
                    return {"status": error.code, "detail": error.read().decode()}
            pause.wait(0.2)

    def deployment(self, flow: str) -> Any:
        """One of the service's."""
        return self.call(f"/deployments/name/{flow}/{flow}%20{self._name}")

    def run(self, flow: str, **wanted: Any) -> Any:
        """Press Run; returns the flow run, or the refusal."""
        data = {"parameters": {"wanted": wanted}, "state": {"type": "SCHEDULED"}}
        return self.call(f"/deployments/{self.deployment(flow)['id']}/create_flow_run", data)

    def state(self, run: str) -> Any:
        """Of a flow run."""
        return self.call(f"/flow_runs/{run}")["state"]

    def ended(self, run: str) -> Any:
        """Its last state, waited for."""
        # each question costs the server more than a collection that waits
        until(f"the end of {run}", lambda: self.state(run)["type"] in FINAL, pause_s=0.5)
        return self.state(run)

    def cancel(self, run: str) -> None:
        """Press Cancel."""
        answer = self.call(f"/flow_runs/{run}/set_state", {"state": {"type": "CANCELLING"}})
        assert answer["status"] == "ACCEPT", answer

    def artifacts(self, run: str) -> dict[str, Any]:
        """Of a flow run, by kind."""
        asked = {"artifacts": {"flow_run_id": {"any_": [run]}}}
        return {item["type"]: item for item in self.call("/artifacts/filter", asked)}


@contextmanager
def serving(
    store: Path,
    rig: Path,
    name: str,
    server: tuple[str, str] | None,
    log: Path,
    schedules: Path | None = None,
) -> Iterator[Page]:
    """`sliplab serve` as a process of its own.

    Args:
        server: address and password of a Prefect server; None for the service's own.
    """
    command = [sys.executable, "-m", "sliplab", "serve", "--store", str(store), "--rig", str(rig)]
    command += [] if schedules is None else [str(schedules)]
    command += ["--port", "0"]
    environment = {key: value for key, value in os.environ.items() if key != "PREFECT_HOME"}
    if server is not None:
        environment |= {"PREFECT_API_URL": server[0], "PREFECT_API_AUTH_STRING": server[1]}
    with log.open("w") as output:
        process = subprocess.Popen(
            [*command, "--name", name, "--poll", "0.6"],
            cwd=ROOT,
            env=environment,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    try:
        until(
            "the service",
            lambda: process.poll() is not None or "; Ctrl-C ends" in log.read_text(),
        )
        assert process.poll() is None, log.read_text()
        if server is None:
            found = re.search(r"Prefect's page: (http://[\d.]+:\d+)", log.read_text())
            assert found is not None, log.read_text()
            server = f"{found[1]}/api", (store / ".prefect" / "page-password").read_text().strip()
        yield Page(*server, name, log)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0, log.read_text()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(60)


class Service:
    """A service of its own process with its own server, as a stranger reaches it: raw HTTP."""

    def __init__(self, page: Page, store: Path) -> None:
        self.page, self.store = page, store
        self.port = urlsplit(page.url).port or 0
        self.host = f"127.0.0.1:{self.port}"

    def runs(self) -> int:
        """How many flow runs there are."""
        return len(self.page.call("/flow_runs/filter", {}))

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
