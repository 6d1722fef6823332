"""Short versions of `python -m tests.crash`, each in one process of its own that may fork."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.conftest import ROOT
from tests.crash.__main__ import PARTS

pytestmark = pytest.mark.programs


@pytest.mark.parametrize(
    ("kills", "trials", "every", "step"),
    [(10, 8, 120, 131072), pytest.param(20, 12, 60, 32768, marks=pytest.mark.long)],
)
def test_a_short_crash_test(kills: int, trials: int, every: int, step: int) -> None:
    sizes = {"kills": kills, "trials": trials, "every": every, "step": step, "seed": 3}
    options = [f"--{name}={size}" for name, size in sizes.items()]
    options += [f"--only={part}" for part in PARTS]  # a named part has no video, and is quicker
    done = subprocess.run(
        [sys.executable, "-m", "tests.crash", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=1500,
    )
    found = json.loads(done.stdout)
    assert {part: found[part]["wrong"] for part in PARTS} == {part: [] for part in PARTS}
    assert done.returncode == 0
