"""What a rig file says of the pilot that it was fitted to."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sliplab.protocols import InputError, load_plan
from sliplab.rigs.rig_file import load_rig_file
from sliplab.rigs.twin import TwinRecord, warnings

RECORD: dict[str, Any] = {
    "campaign": "pilot",
    "checksum": "00",
    "trials": 30,
    "simulated": True,
    "fitted": "2026-11-26",
    "method": "regression on 400 simulated worlds",
    "depth_mm": {"least": 2.4, "most": 3.4},
    "speed_mm_s": {"least": 0.6, "most": 1.6},
    "parameters": {
        "scene.friction.kinetic": {"value": 0.7, "low": 0.68, "high": 0.72, "identified": True}
    },
}


def test_a_plan_within_the_pilot_leaves_nothing() -> None:
    twin = TwinRecord.model_validate(RECORD)
    assert list(warnings(twin, load_plan(Path("pilot")))) == []


def test_a_plan_that_goes_deeper_or_faster_says_by_how_much() -> None:
    less = RECORD | {
        "depth_mm": {"least": 2.4, "most": 3.0},
        "speed_mm_s": {"least": 1.0, "most": 1.6},
    }
    twin = TwinRecord.model_validate(less)
    assert list(warnings(twin, load_plan(Path("pilot")))) == [
        "depth 2.4 to 3.4 mm in contact; the twin was fitted on 2.4 to 3 mm",
        "speed 0.6 to 1.6 mm/s in contact; the twin was fitted on 1 to 1.6 mm/s",
    ]


def test_a_retraction_is_in_contact_from_the_press_on() -> None:
    """It ends clear of the plate: its last depth once stood for all of it."""
    twin = TwinRecord.model_validate(RECORD)
    assert list(warnings(twin, load_plan(Path("gravity")))) == [
        "depth 0 to 4 mm in contact; the twin was fitted on 2.4 to 3.4 mm",
        "speed 0.3 to 0.7 mm/s in contact; the twin was fitted on 0.6 to 1.6 mm/s",
    ]


def test_what_the_scene_lacks_is_said_of_every_plan() -> None:
    twin = TwinRecord.model_validate(RECORD | {"misfits": ["events: light that flickers"]})
    assert list(warnings(twin, load_plan(Path("pilot")))) == [
        "the pilot shows what this scene lacks (events: light that flickers)"
    ]


def test_a_twin_is_a_simulated_rig(tmp_path: Path) -> None:
    file = tmp_path / "twin.yaml"
    rows = "twin: {campaign: pilot, checksum: '00', trials: 30, simulated: false, "
    rows += "fitted: 2026-11-26, method: x, depth_mm: {least: 2, most: 3}, "
    rows += "speed_mm_s: {least: 1, most: 2}, parameters: {}}\n"
    file.write_text(f"extends: rehearsal\nname: twin\n{rows}")
    rig, _ = load_rig_file(file)
    assert rig.twin.trials == 30
    file.write_text(f"extends: ur5\nname: twin\n{rows}")
    with pytest.raises(InputError, match="has no meaning with driver: devices"):
        load_rig_file(file)
