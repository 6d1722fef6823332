"""Where a simulated rig detects touches, and how exact a pilot's depth zero is."""

from __future__ import annotations

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import build_mock
from sliplab.plugins.simulation.rig import simulated_rig
from sliplab.plugins.simulation.scene_runs import changed
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.pilots import zero_error_mm
from sliplab.plugins.twin.worlds import touch_depth_mm
from sliplab.rigs.core.surface_search import touch_off
from sliplab.rigs.rig_file import RigFile, load_rig_file
from sliplab.rigs.rig_inheritance import shipped_rigs


def zero_errors_mm(rig: RigFile, seeds: Iterable[int]) -> list[float]:
    """How far from the surface touching off finds depth zero."""
    devices = build_mock(scene_of(rig), rig.timing)
    made = simulated_rig(rig, devices)
    try:
        made.connect()
        surface = devices.world.plane.pose(0.0, 0.0, 0.0).xyz_mm
        true = made.plate_frame.with_zero(0.0).position(surface).depth_mm
        return [touch_off(made, 0.5, 1.5, seed) - true for seed in seeds]
    finally:
        made.close()


@pytest.mark.long
def test_the_shipped_rigs_touch_depth_is_that_of_its_camera_and_skin() -> None:
    rig, _ = load_rig_file(shipped_rigs()["rehearsal"])
    assert touch_depth_mm(rig) == pytest.approx(rig.calibration.touch_depth, abs=0.03)


@pytest.mark.long
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
    assert zero_errors_mm(other, [77])[0] > 0.1
    depth_mm = touch_depth_mm(other)
    calibration = other.calibration.model_copy(update={"touch_depth": depth_mm})
    own = other.model_copy(update={"calibration": calibration})
    assert abs(zero_errors_mm(own, [77])[0]) < 0.06


@pytest.mark.long
def test_touches_that_differ_leave_no_common_error_of_depth() -> None:
    rig, _ = load_rig_file(shipped_rigs()["rehearsal"])
    few_pixels = {
        "px_per_mm": 12.3,
        "radius_mm": 1.07,
        "growth_mm_per_n": 0.37,
        "noise_hz": 0.012,
        "hot_pixels": 12,
        "hot_hz": 13.0,
    }
    other = changed(rig, {"event_camera": few_pixels})
    calibration = other.calibration.model_copy(update={"touch_depth": touch_depth_mm(other)})
    own = other.model_copy(update={"calibration": calibration})
    errors = zero_errors_mm(own, range(100, 124))
    assert np.std(errors) > 0.04
    # the standard error of both means is 0.017 mm
    assert abs(np.mean(errors)) < 0.03


@pytest.mark.parametrize(
    ("sd_mm", "touches", "most_mm"),
    [(None, 1, 0.1), (0.02, 8, 0.03), (0.05, 8, 0.06), (0.05, 2, 0.1), (0.2, 8, 0.1)],
)
def test_the_error_of_depth_zero_follows_from_the_touches(
    sd_mm: float | None, touches: int, most_mm: float
) -> None:
    """Two standard errors of the mean and 0.02 mm of the touch depth, in quadrature."""
    maintenance = SimpleNamespace(rezero=SimpleNamespace(touches=touches))
    protocol = SimpleNamespace(collection=SimpleNamespace(maintenance=maintenance))
    record = SimpleNamespace(record=SimpleNamespace(depth_zero_sd_mm=sd_mm))
    item: Any = SimpleNamespace(plan=SimpleNamespace(protocol=protocol), trials=[(None, record)])
    assert zero_error_mm(item) == most_mm
    maintenance.rezero = None
    assert zero_error_mm(item) == 0.1
