"""A rig drives the real UR driver as it drives a simulated arm: real time, real client."""

from __future__ import annotations

import threading
import time
from typing import Any, cast

import numpy as np
import pytest

from sliplab.rigs.core.capabilities import (
    ArmFault,
    ArmState,
    EventCamera,
    FrameCamera,
    Operator,
    SyncBox,
)
from sliplab.rigs.core.fakes import Fault, Kind, Stage
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.rig import Rig
from tests.plugins.devices.conftest import MakeArm, MakeRobot
from tests.rigs.waiting import until

pytestmark = pytest.mark.realtime

LIMITS: dict[str, Any] = {
    "low_mm": (-20, -20, -30),
    "high_mm": (20, 20, 5),
    "frame": "plate",
    "plate": {"centre_mm": (400, 0, 290), "right_mm": (420, 0, 290), "above_mm": (400, -20, 290)},
    "depth_mm": 3.0,
}


class HostClock:
    """The host's own clock."""

    def __init__(self) -> None:
        self._never = threading.Event()

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        self._never.wait(seconds)


class Nothing:
    """A camera or sync box that is only ever connected and stopped."""

    def connect(self) -> None: ...

    def stop(self) -> None: ...

    def close(self) -> None: ...


def rig_on(arm: Any) -> Rig:
    plate = LIMITS["plate"]
    frame = PlateFrame.taught((plate["centre_mm"], plate["right_mm"], plate["above_mm"]))
    assert frame.axes[2] == pytest.approx(np.array([0, 0, -1]))  # down into the plate
    nothing: Any = Nothing()
    return Rig(
        name="ur",
        clock=HostClock(),
        arm=arm,
        event_camera=cast("EventCamera", nothing),
        frame_camera=cast("FrameCamera", nothing),
        sync=cast("SyncBox", nothing),
        operator=cast("Operator", nothing),
        plate_frame=frame,
        poll_s=0.02,
    )


def test_a_rig_presses_with_a_real_driver(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    robot = robot_of()
    arm = arm_on(robot, connected=False, limits=LIMITS)
    rig = rig_on(arm)
    rig.connect()
    arm.read_poses()
    rig.press(depth_mm=2.0, speed_mm_s=10.0, clearance_mm=2.0, times=2)
    deep = 290 - arm.read_poses().xyz_mm[:, 2]
    assert deep.max() == pytest.approx(2.0, abs=0.01)
    assert robot.pose().xyz_mm[2] == pytest.approx(292.0, abs=0.01)
    rig.close()
    assert arm.state() is ArmState.DISCONNECTED


def test_a_rig_hears_of_a_protective_stop_and_retracts_nothing(robot_of: Any, arm_on: Any) -> None:
    robot = robot_of(faults=[Fault(Kind.PROTECTIVE_STOP, Stage.MOVING, after_mm=3.0)])
    arm = arm_on(robot, connected=False, limits=LIMITS)
    rig = rig_on(arm)
    rig.connect()
    with pytest.raises(ArmFault, match=r"protective stop .* unlock the stop at the pendant"):
        rig.press(depth_mm=2.0, speed_mm_s=10.0, clearance_mm=2.0, times=1)
    until(lambda: not robot.moving(), 1.0)
    assert robot.pose().xyz_mm[2] == pytest.approx(297.0, abs=0.3)
    assert not robot.program.program_running
