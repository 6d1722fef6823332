"""Short versions of `python -m tests.crash`, in a process of its own that may fork."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT


@pytest.mark.parametrize(
    ("part", "options"),
    [
        ("kills", ["--kills", "20", "--trials", "12"]),
        ("power", ["--every", "60"]),
        ("full", ["--step", "32768"]),
        ("read_only", []),
    ],
)
def test_a_short_crash_test(part: str, options: list[str]) -> None:
    command = [sys.executable, "-m", "tests.crash", "--only", part, "--seed", "3", *options]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600)
    found = json.loads(done.stdout)[part]
    assert found["wrong"] == []
    assert done.returncode == 0
