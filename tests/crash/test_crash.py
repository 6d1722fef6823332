"""Short versions of `python -m tests.crash`, in one process of their own that may fork."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tests.crash.__main__ import PARTS

pytestmark = pytest.mark.programs


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize(
    ("kills", "trials", "every", "step"),
    [(10, 8, 120, 131072), pytest.param(20, 12, 60, 32768, marks=pytest.mark.long)],
)
def test_a_short_crash_test(part: str, kills: int, trials: int, every: int, step: int) -> None:
    options = [
        "--kills",
        str(kills),
        "--trials",
        str(trials),
        "--every",
        str(every),
        "--step",
        str(step),
    ]
    done = subprocess.run(
        [sys.executable, "-m", "tests.crash", "--only", part, "--seed", "3", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=600,
    )
    found = json.loads(done.stdout)
    assert found[part]["wrong"] == []
    assert done.returncode == 0
