"""Programs in processes of their own, which keep no home of Prefect that tests share."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tests.conftest import ROOT

NO_SERVER = {"PREFECT_API_URL": "http://127.0.0.1:9/api"}
"""Where no server answers: starting one takes longer than many a program's work."""


def environment(**changes: str) -> dict[str, str]:
    """Return what a program is started with."""
    kept = {name: value for name, value in os.environ.items() if name != "PREFECT_HOME"}
    return {**kept, "PYTHONPATH": str(ROOT), **changes}


def ended(
    command: Sequence[object], limit_s: float = 240, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a program to its end."""
    defaults = {"cwd": ROOT, "env": environment(), "text": True, "timeout": limit_s}
    words = [*map(str, command)]
    return subprocess.run(words, capture_output=True, check=False, **{**defaults, **options})


@contextmanager
def running(
    command: Sequence[object], log: Path, env: dict[str, str] | None = None, cwd: Path = ROOT
) -> Iterator[subprocess.Popen[str]]:
    """Run a program in a session of its own; nothing of it is left when the block ends."""
    with log.open("w") as messages:
        process = subprocess.Popen(
            [*map(str, command)],
            cwd=cwd,
            env=environment() if env is None else env,
            text=True,
            start_new_session=True,
            stdout=subprocess.DEVNULL,
            stderr=messages,
        )
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait(60)
