"""The mock's fingers: depth in contact, stall at the normal force, and plates that they hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.capabilities import Gripper, RigError, Segment
from tests.plugins.simulation.driving import SMALL, go

GRIP = {"force_n": [1.0, 50.0]}


def with_gripper(**more: Any) -> MockDevices:
    data = {**SMALL.model_dump(), "gripper": GRIP, **more}
    devices = build_mock(MockSettings.model_validate(data))
    devices.arm.connect()
    devices.gripper.connect()
    return devices


def pressed(devices: MockDevices, depth_mm: float, seed: int = 3) -> float:
    """Press the sensor, wait until it relaxed, and return the normal force, N."""
    go(devices, 0, 0, -2, 50.0, 0.05, lambda: None)
    devices.begin_trial(seed)
    go(devices, 0, 0, depth_mm, 4.0, 0.05, lambda: None)
    devices.clock.wait(1.0)
    devices.world.advance()
    return normal_n(devices)


def normal_n(devices: MockDevices) -> float:
    return float(devices.world.physics.tips.normal.sum())


def peak_n(devices: MockDevices, limit_n: float, by_mm: float = 2.0, speed: float = 150.0) -> float:
    """Close the fingers and return the largest normal force on the way."""
    kept = devices.world.keep_wrench("test")
    devices.gripper.move(40.0 - by_mm, speed, limit_n)
    devices.clock.wait(1.0)
    devices.world.advance()
    devices.world.drop_wrench("test")
    return float(kept.between(kept.begin_ns, kept.end_ns)[1][:, 2].max())


@pytest.mark.parametrize("speed", [20.0, 150.0])
@pytest.mark.parametrize("depth_mm", [1.0, 2.4, 4.0])
def test_fingers_stall_at_their_force_and_never_pass_it(depth_mm: float, speed: float) -> None:
    devices = with_gripper()
    limit_n = pressed(devices, depth_mm) + 1.0
    most = peak_n(devices, limit_n, speed=speed)
    assert limit_n - 0.3 < most < limit_n
    state = devices.gripper.state()
    assert state.stalled
    assert 38.0 < state.opening_mm < 40.0
    devices.clock.wait(5.0)
    devices.world.advance()
    assert normal_n(devices) < limit_n  # it relaxes, and the fingers stay


def test_fingers_that_begin_beyond_their_force_do_not_move() -> None:
    devices = with_gripper()
    force_n = pressed(devices, 3.0)
    assert peak_n(devices, force_n - 1.0) == pytest.approx(force_n, abs=0.01)
    assert devices.gripper.state().opening_mm == pytest.approx(40.0, abs=1e-6)


def test_what_fingers_close_is_depth() -> None:
    """Fingers that close by as much as an arm presses leave the same forces in the end."""
    by_arm, by_fingers = with_gripper(), with_gripper()
    pressed(by_arm, 3.0)
    pressed(by_fingers, 2.5)
    peak_n(by_fingers, 50.0, 0.5)
    for devices in (by_arm, by_fingers):
        devices.clock.wait(10.0)
        devices.world.advance()
    normals = (devices.world.physics.tips.normal for devices in (by_fingers, by_arm))
    np.testing.assert_allclose(*normals, rtol=1e-3)


def test_how_often_the_state_is_read_changes_nothing() -> None:
    tracks = []
    for step_s in (0.001, 0.05):
        devices = with_gripper()
        pressed(devices, 3.0)
        devices.gripper.move(38.0, 50.0, normal_n(devices) + 0.5)
        for _ in range(round(0.2 / step_s)):
            devices.clock.wait(step_s)
            devices.gripper.state()
        devices.world.advance()
        tracks.append(devices.world.physics.track.between(0, devices.world.physics.track.end_ns))
    for first, second in zip(*tracks, strict=True):
        np.testing.assert_array_equal(first, second)


def fallen_mm(grip_mm: float) -> float:
    """Way that a plate falls within 2 s as the sensor retracts, and fingers close on the way."""
    devices = with_gripper()
    devices.operator.ask("changeover", "Mount the plate.", "0.205 kg")
    go(devices, 0, 0, -5, 50.0, 0.1, lambda: None)
    devices.begin_trial(5)
    devices.plate.act("raise", 0.2)
    devices.clock.wait(0.2)
    go(devices, 0, 0, 3.4, 4.0, 0.1, lambda: None)
    devices.plate.act("release", 0.5)
    devices.clock.wait(1.0)
    devices.arm.start([Segment(devices.world.plane.pose(0, 0, 2.3), 1.0)])
    devices.clock.wait(0.4)
    if grip_mm:
        devices.gripper.move(40.0 - grip_mm, 150.0, 50.0)
    devices.clock.wait(2.0)
    devices.world.advance()
    track = devices.world.physics.track
    return -float(track.at(np.array([track.end_ns]))[0, -1])


def test_a_plate_that_falls_without_a_grip_is_caught_on_its_way_by_one() -> None:
    assert fallen_mm(0.0) == pytest.approx(25.0)
    assert 0.5 < fallen_mm(1.5) < 10.0


def test_without_a_gripper_nothing_has_changed() -> None:
    bare, idle = build_mock(SMALL), with_gripper()
    bare.arm.connect()
    for devices in (bare, idle):
        pressed(devices, 3.0)
    np.testing.assert_array_equal(bare.world.physics.tips.state, idle.world.physics.tips.state)
    assert bare.gripper is None


def test_a_gripper_refuses_what_is_out_of_its_range() -> None:
    devices = with_gripper()
    assert isinstance(devices.gripper, Gripper)
    for wrong, said in (
        ((90.0, 50.0, 5.0), "opening 90 mm is out of its range, 0 to 85 mm"),
        ((30.0, 5.0, 5.0), "speed 5 mm/s is out of its range, 20 to 150 mm/s"),
        ((30.0, 50.0, 0.5), "force 0.5 N is out of its range, 1 to 50 N"),
        ((float("nan"), 50.0, 5.0), "opening nan mm"),
    ):
        with pytest.raises(RigError, match=said):
            devices.gripper.move(*wrong)
    assert not devices.gripper.state().moving


def test_a_gripper_without_power_does_not_answer() -> None:
    fault = {"kind": "device_gone", "device": "gripper", "at_s": 0.0, "since": "trial"}
    devices = with_gripper(faults=[fault])
    devices.begin_trial(1)
    devices.clock.wait(0.1)
    with pytest.raises(RigError, match="gripper: does not answer"):
        devices.gripper.move(30.0, 50.0, 5.0)
