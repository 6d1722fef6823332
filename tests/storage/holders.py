"""Another program that holds a lock."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.conftest import ROOT


@contextmanager
def holder_of(code: str, *words: Any, **how: Any) -> Iterator[subprocess.Popen[str]]:
    """Run code that says `held` and then waits; kill it in the end."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    line = [sys.executable, "-c", code, *words]
    holder: Any = subprocess.Popen(line, cwd=ROOT, text=True, **pipes, **how)
    try:
        assert holder.stdout.readline() == "held\n"
        yield holder
    finally:
        holder.kill()
        holder.communicate(timeout=60)
