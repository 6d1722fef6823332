"""Some fixed seeds of the storm, each in a process that may fork."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from sliplab.rigs.core.faults import KINDS
from tests.conftest import ROOT
from tests.storm.story import FAULTS, STEPS, draw

pytestmark = pytest.mark.programs


def storm(*options: str) -> dict[str, Any]:
    """Run the storm as a person does; what it printed."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.storm", "--json", *options],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    found: dict[str, Any] = json.loads(done.stdout)
    assert done.returncode == bool(found["failed"]), done.stderr
    return found


def test_every_fault_that_a_rig_file_may_name_is_part_of_the_storm() -> None:
    assert {*FAULTS} == {*KINDS}


def test_every_kind_of_step_is_drawn() -> None:
    drawn = {step["do"] for seed in range(100) for step in draw(seed)["steps"]}
    assert drawn == {*STEPS}


def test_no_invariant_is_broken_and_a_seed_is_one_story_with_one_trace() -> None:
    both, second = storm("--seed=40", "--stories=2"), storm("--seed=41", "--stories=1")
    assert both["failed"] == second["failed"] == []
    assert both["hashes"].items() > second["hashes"].items()


@pytest.mark.long
def test_a_planted_defect_is_found() -> None:
    found = storm("--plant=hold_short", "--stories=1", "--no-shrink")
    assert found["failed"] != []
