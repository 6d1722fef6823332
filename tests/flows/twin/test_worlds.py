"""Where a simulated rig detects touches: its file must say so for depth zero to be right."""

from __future__ import annotations

import pytest

from sliplab.flows.scene_runs import changed
from sliplab.flows.twin.worlds import touch_depth_mm
from sliplab.rigs.build import simulated_rig
from sliplab.rigs.mock.devices import build_mock
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs


def zero_error_mm(rig: RigFile, seed: int) -> float:
    """How far from the surface touching off finds depth zero."""
    devices = build_mock(rig.scene, rig.timing)
    made = simulated_rig(rig, devices)
    try:
        made.connect()
        surface = devices.world.plane.pose(0.0, 0.0, 0.0).xyz_mm
        true = made.plate_frame.with_zero(0.0).position(surface).depth_mm
        return made.touch_off(0.5, 1.5, seed) - true
    finally:
        made.close()


def test_the_shipped_rigs_touch_depth_is_that_of_its_camera_and_skin() -> None:
    rig, _ = load_rig_file(shipped_rigs()["rehearsal"])
    assert touch_depth_mm(rig) == pytest.approx(rig.calibration.touch_depth, abs=0.03)


def test_depth_zero_is_right_with_the_rigs_own_touch_depth() -> None:
    rig, _ = load_rig_file(shipped_rigs()["rehearsal"])
    # a softer skin, seen smaller and fainter, is noticed deeper
    other = changed(
        rig,
        {
            "scene": {"skin": {"youngs_modulus_mpa": 0.4}},
            "event_camera": {"px_per_mm": 11.0, "growth_mm_per_n": 0.3, "contrast": 1.75},
        },
    )
    assert zero_error_mm(other, 77) > 0.1
    depth_mm = touch_depth_mm(other)
    calibration = other.calibration.model_copy(update={"touch_depth": depth_mm})
    own = other.model_copy(update={"calibration": calibration})
    assert abs(zero_error_mm(own, 77)) < 0.06
