"""A service and a Prefect server as tests meet them: from outside, over HTTP."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tests.conftest import ROOT

LIMIT_S = 120.0
FINAL = {"COMPLETED", "FAILED", "CRASHED", "CANCELLED"}


def until(what: str, found: Callable[[], Any], limit_s: float = LIMIT_S) -> Any:
    """What `found` returns, as soon as that is true."""
    end = time.monotonic() + limit_s
    pause = threading.Event()
    while not (answer := found()):
        assert time.monotonic() < end, f"waited {limit_s:g} s for {what}"
        pause.wait(0.05)
    return answer


class Page:
    """What a person does on Prefect's page."""

    def __init__(self, url: str, name: str) -> None:
        self._url, self._name = url, name

    def call(self, path: str, data: Any = None) -> Any:
        """The server's answer, or ``{"status": ..., "detail": ...}`` of its refusal."""
        body = None if data is None else json.dumps(data).encode()
        headers = {"content-type": "application/json"}
        request = urllib.request.Request(f"{self._url}{path}", body, headers)
        try:
            with urllib.request.urlopen(request, timeout=30) as answer:
                return json.loads(answer.read() or b"null")
        except urllib.error.HTTPError as error:
            return {"status": error.code, "detail": error.read().decode()}

    def deployment(self, flow: str) -> Any:
        """One of the service's."""
        return self.call(f"/deployments/name/{flow}/{self._name}")

    def run(self, flow: str, **wanted: Any) -> Any:
        """Press Run; returns the flow run, or the refusal."""
        data = {"parameters": {"wanted": wanted}, "state": {"type": "SCHEDULED"}}
        return self.call(f"/deployments/{self.deployment(flow)['id']}/create_flow_run", data)

    def state(self, run: str) -> Any:
        """Of a flow run."""
        return self.call(f"/flow_runs/{run}")["state"]

    def ended(self, run: str) -> Any:
        """Its last state, waited for."""
        until(f"the end of {run}", lambda: self.state(run)["type"] in FINAL)
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
def serving(store: Path, rig: Path, name: str, url: str, log: Path) -> Iterator[Page]:
    """`sliplab serve` as a process of its own on the Prefect server at `url`."""
    command = [sys.executable, "-m", "flows", "serve", "--store", str(store), "--rig", str(rig)]
    environment = {**os.environ, "PREFECT_API_URL": url}
    environment.pop("PREFECT_HOME", None)
    with log.open("w") as output:
        process = subprocess.Popen(
            [*command, "--name", name, "--poll", "0.3"],
            cwd=ROOT, env=environment, stdout=output, stderr=output, start_new_session=True,
        )  # fmt: skip
    try:
        until(
            "the service",
            lambda: process.poll() is not None or "\nPrefect's page:" in log.read_text(),
        )
        assert process.poll() is None, log.read_text()
        yield Page(url, name)
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0, log.read_text()
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(60)
