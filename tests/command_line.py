"""The command line as tests use it: in a process of its own, or in this one."""

from __future__ import annotations

import contextlib
import io
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from sliplab.flows.__main__ import main
from tests.conftest import ROOT

SECRET = "marked-secret-51b2"
"""In the environment of every command; must never be found in a store."""
SLIPLAB = [sys.executable, "-m", "sliplab"]
MANY = """
import contextlib, io, json, sys
from sliplab.flows.__main__ import main

ended = []
for words in json.loads(sys.argv[1]):
    sys.argv[1:] = words
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        try:
            main()
        except SystemExit as end:
            ended.append([end.code, out, said])
print(json.dumps([[code, out.getvalue(), said.getvalue()] for code, out, said in ended]))
"""
"""Program that runs commands, given as JSON, one after the other: exit code and both streams."""


def sliplab(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run a command to its end, in a process of its own."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    environment.pop("PREFECT_HOME", None)
    environment |= dict.fromkeys(("PREFECT_API_KEY", "AWS_SECRET_ACCESS_KEY"), SECRET)
    return subprocess.run(
        [*SLIPLAB, *map(str, arguments)],
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=300,
    )


def here(*arguments: object, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """The same in this process, which has loaded everything already."""
    words = ["sliplab", *map(str, arguments)]
    out, said = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", words)
        # Prefect's set-up ends all handlers: that of absl would close what it took for its stream
        patch.setattr("logging.shutdown", lambda *_: None)
        patch.chdir(cwd)
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(said),
            pytest.raises(SystemExit) as ended,
        ):
            main()
    code = ended.value.code
    assert isinstance(code, int)
    return subprocess.CompletedProcess(words, code, out.getvalue(), said.getvalue())


def answer(*arguments: object) -> dict[str, Any]:
    """Run a command in this process, expect success and return its JSON object."""
    done = here(*arguments, "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def outcome(*arguments: object) -> tuple[int, Any, str]:
    """Run a command in this process: exit code, JSON object (None without --json), messages."""
    done = here(*arguments)
    found = json.loads(done.stdout) if "--json" in arguments else None
    return done.returncode, found, done.stderr


def wait_for(condition: object, process: subprocess.Popen[str], limit_s: float = 120.0) -> None:
    """Until `condition()` holds; fails when the process ends first or time is up."""
    assert callable(condition)
    end = time.monotonic() + limit_s
    while not condition():
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=0.01)
        assert process.poll() is None, "ended before it could be stopped"
        assert time.monotonic() < end, "never came that far"
