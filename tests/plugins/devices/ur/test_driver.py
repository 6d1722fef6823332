"""The UR driver on a fake through the real ur_rtde: slides, streams, guards, stops."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from sliplab.plugins.devices import ur
from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.rigs.core.capabilities import (
    Arm,
    ArmFault,
    ArmState,
    Pose,
    RigError,
    Segment,
    StoppingArm,
)
from sliplab.rigs.core.fakes import HOME, Fault, Kind, Stage
from sliplab.rigs.core.guard import SingularityError, SpeedError, WorkspaceError
from sliplab.rigs.core.plate_frame import turned_about_z
from sliplab.storage.streams import PoseChunk
from tests.plugins.devices.arms import at
from tests.plugins.devices.conftest import MakeArm, MakeRobot, MakeUr, ur_settings
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime


def follow(arm: UrArm, *segments: Segment, within_s: float = 30.0) -> tuple[tuple[int, int], ...]:
    arm.start(segments)
    until(lambda: arm.progress().done, within_s)
    return arm.progress().finished


def test_a_twist_is_on_the_spot_and_at_its_speed(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    """A turn about the tool's z axis of 20 degrees at 4 deg/s."""
    arm = arm_on(robot_of(rate=5.0))
    arm.read_poses()
    turned = Pose(HOME.xyz_mm, turned_about_z(HOME.rotvec_deg, -20.0))
    (span,) = follow(arm, Segment(turned, 10.0, 4.0))
    chunk = arm.read_poses()
    t_s, xyz = middle(chunk, span)
    assert np.ptp(xyz, axis=0).max() < 1e-3
    margin = (span[1] - span[0]) // 20
    inside = (chunk.t_ns >= span[0] + margin) & (chunk.t_ns <= span[1] - margin)
    begin = Rotation.from_rotvec(HOME.rotvec_deg, degrees=True)
    angle = begin.inv() * Rotation.from_rotvec(chunk.rotvec_deg[inside], degrees=True)
    vector = angle.as_rotvec(degrees=True)
    assert np.polyfit(t_s, vector[:, 2], 1)[0] == pytest.approx(-4.0, rel=0.01)
    assert np.abs(vector[:, :2]).max() < 1e-3
    assert (span[1] - span[0]) / 1e9 == pytest.approx(20 / 4.0, rel=0.05)


def middle(chunk: PoseChunk, span: tuple[int, int]) -> tuple[npt.NDArray[np.float64], ...]:
    """Times (s) and places (mm) of the middle 90 % of a segment."""
    margin = (span[1] - span[0]) // 20
    inside = (chunk.t_ns >= span[0] + margin) & (chunk.t_ns <= span[1] - margin)
    return (chunk.t_ns[inside] - span[0]) / 1e9, chunk.xyz_mm[inside]


@pytest.mark.parametrize(
    "rate", [5.0, pytest.param(1.0, id="real time, 10 s", marks=pytest.mark.long)]
)
def test_a_slide_at_1_6_mm_s_is_straight_and_at_its_speed(
    robot_of: MakeRobot, arm_on: MakeArm, rate: float
) -> None:
    check_slide(robot_of, arm_on, 1.6, rate)


@pytest.mark.long
def test_a_slide_at_0_6_mm_s_is_straight_and_at_its_speed(robot_of: Any, arm_on: MakeArm) -> None:
    check_slide(robot_of, arm_on, 0.6, rate=5.0)  # 25 s of controller time


def check_slide(robot_of: MakeRobot, arm_on: MakeArm, speed: float, rate: float) -> None:
    arm = arm_on(robot_of(rate=rate))
    arm.read_poses()
    finished = follow(arm, Segment(at(15.0), speed))
    assert finished, arm.state()
    (span,) = finished
    chunk = arm.read_poses()
    t_s, xyz = middle(chunk, span)
    assert np.polyfit(t_s, xyz[:, 1], 1)[0] == pytest.approx(speed, rel=0.005)
    assert np.ptp(xyz[:, [0, 2]], axis=0).max() < 0.05
    assert (span[1] - span[0]) / 1e9 == pytest.approx(15 / speed, rel=0.01)
    assert set(np.diff(chunk.t_ns)) == {8_000_000}  # none lost, none twice
    assert np.all(np.diff(chunk.host_ns) >= 0)
    assert chunk.xyz_mm[-1] == pytest.approx(at(15.0).xyz_mm, abs=1e-6)


def test_a_path_of_segments_is_followed_from_rest_to_rest(robot_of: Any, arm_on: MakeArm) -> None:
    arm = arm_on(robot_of(rate=5.0))
    spans = follow(
        arm, Segment(at(10.0), 20.0), Segment(at(10.0, 297.0), 5.0), Segment(at(0.0), 40.0)
    )
    lengths = [10.0 / 20, 3.0 / 5, np.hypot(10, 3) / 40]
    assert len(spans) == 3
    for (start, end), seconds, after in zip(spans, lengths, [*spans[1:], None], strict=True):
        assert (end - start) / 1e9 == pytest.approx(seconds, abs=0.45)  # its two ramps
        assert after is None or end < after[0]
    assert arm.pose().xyz_mm == pytest.approx(at(0.0).xyz_mm, abs=1e-6)
    assert arm.state() is ArmState.READY


def test_it_is_an_arm_with_its_tool_payload_and_watchdog_set(robot_of: Any, arm_on: Any) -> None:
    robot = robot_of()
    tool = {"tcp_mm": (0, 0, 120), "tcp_rotvec_deg": (0, 0, 90), "mass_kg": 0.4}
    arm = arm_on(robot, tool=tool)
    assert isinstance(ur.DRIVER.build(ur_settings("127.0.0.1")), Arm)
    assert arm.pose() == HOME
    assert robot.program.tcp == pytest.approx([0, 0, 0.12, 0, 0, np.pi / 2])
    assert robot.program.payload_kg == 0.4
    now = arm.now_ns()
    until(lambda: arm.now_ns() > now, 1.0)
    assert abs(arm.now_ns() / 1e9 - robot.clock.now_s()) < 0.5


def test_sync_pulses_are_rising_edges_in_controller_time(robot_of: Any, arm_on: MakeArm) -> None:
    robot = robot_of(digital_inputs=lambda t_s: int(t_s * 10) % 2 << 3)  # 5 Hz on input 3
    arm = arm_on(robot, sync_input=3)
    arm.read_pulses()
    began = arm.now_ns()
    until(lambda: arm.now_ns() - began > 1.5e9, 5.0)
    pulses = arm.read_pulses().t_ns
    assert len(pulses) >= 7
    assert np.diff(pulses) == pytest.approx(0.2e9, abs=8e6)
    assert np.all(pulses % 200_000_000 >= 100_000_000 - 8_000_000)


def test_a_stop_in_a_slide_stands_still_soon_and_says_so(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair()
    arm.start([Segment(at(15.0), 1.6), Segment(at(0.0), 1.6)])
    until(lambda: robot.pose().xyz_mm[1] > 1.0, 5.0)
    began = time.monotonic()
    arm.stop()
    assert time.monotonic() - began < 1.0
    assert not robot.moving()
    progress = arm.progress()
    assert progress.done
    assert progress.finished == ()
    assert arm.state() is ArmState.READY
    arm.stop()  # more than once
    assert len(follow(arm, Segment(at(0.0), 20.0))) == 1  # and it can go on


def test_a_stop_goes_on_as_far_as_it_says(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    """From 40 mm/s at 1 m/s2: 0.8 mm of braking, and a cycle or more on a busy machine."""
    robot = robot_of(cycle_hz=500)
    arm = arm_on(robot, acceleration_mm_s2=1000.0)
    assert isinstance(arm, StoppingArm)
    assert arm.stopping_s(40.0) == pytest.approx(0.022)
    gone = []
    for _ in range(5):
        arm.start([Segment(at(20.0), 40.0)])
        until(lambda: robot.pose().xyz_mm[1] > 5.0, 5.0)
        began = robot.pose().xyz_mm[1]
        arm.stop()
        gone.append(robot.pose().xyz_mm[1] - began)
        follow(arm, Segment(at(0.0), 40.0))
    assert min(gone) > 0.8 - 40.0 / 500  # within a cycle nobody knows where it is
    assert min(gone) < 40.0 * (arm.stopping_s(40.0) + 0.01)


def test_no_move_follows_a_stop_however_short_the_segments(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair()
    for attempt in range(3):
        path = [Segment(at(attempt + 0.1 * step), 20.0) for step in range(1, 60)]
        arm.start(path)
        until(lambda: len(arm.progress().finished) > 2 + attempt, 10.0)  # noqa: B023
        arm.stop()
        where, now = robot.pose(), arm.now_ns()
        until(lambda: arm.now_ns() > now + 300_000_000, 5.0)  # noqa: B023
        assert robot.pose() == where


def test_what_the_guard_forbids_is_never_sent(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(joints_deg=(0, -90, 90, -90, -90, 0))
    with pytest.raises(WorkspaceError, match=r"y in the base frame 101 mm .* 100 mm"):
        arm.start([Segment(at(101.0), 1.0)])
    with pytest.raises(SpeedError, match=r"51 mm/s .* 50 mm/s"):
        arm.start([Segment(at(1.0), 51.0)])
    with pytest.raises(RigError, match="empty"):
        arm.start([])
    assert robot.pose() == HOME
    assert arm.state() is ArmState.READY


def test_the_controllers_own_limits_count_too(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    arm = arm_on(robot_of(reach_mm=510.0))
    with pytest.raises(RigError, match=r"controller reports \(400.0, 100.0, 400.0\)"):
        arm.start([Segment(at(100.0, 400.0), 10.0)])


def test_a_wrist_near_its_singularity_is_not_moved(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    arm = arm_on(robot_of(joints_deg=(0, -90, 90, -90, 2.0, 0)))
    with pytest.raises(SingularityError, match="joint 5"):
        arm.start([Segment(at(1.0), 1.0)])


def test_a_slowed_speed_slider_is_noticed(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair()
    robot.program.speed_fraction = 0.5
    until(lambda: _refuses(arm, "slider is at 50%"), 2.0)
    assert robot.pose() == HOME


def _refuses(arm: UrArm, why: str) -> bool:
    try:
        arm.start([Segment(HOME, 1.0)])
    except ArmFault as error:
        return why in str(error)
    arm.stop()
    return False


@pytest.mark.long
def test_two_robots_have_two_addresses(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    one, other = arm_on(robot_of(rate=5.0)), arm_on(robot_of(rate=5.0))
    one.start([Segment(at(5.0), 20.0)])
    until(lambda: one.progress().done, 5.0)
    assert one.pose().xyz_mm[1] == pytest.approx(5.0)
    assert other.pose() == HOME


def test_a_closed_arm_can_be_connected_again(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair()
    arm.close()
    assert arm.state() is ArmState.DISCONNECTED
    assert not robot.program.program_running
    arm.connect()
    assert arm.state() is ArmState.READY
    assert robot.program.uploads == 2


def test_an_address_where_nothing_listens_is_a_fault() -> None:
    arm = UrArm(ur_settings(own_address()))
    with pytest.raises(ArmFault, match="check its power"):
        arm.connect()
    arm.stop()
    arm.close()


def test_a_move_that_somebody_ends_at_the_pendant_is_not_finished(ur_pair: MakeUr) -> None:
    arm, _ = ur_pair(faults=[Fault(Kind.PROGRAM_END, Stage.MOVING, after_mm=1.0)])
    arm.start([Segment(at(15.0), 5.0)])
    until(lambda: arm.progress().done, 5.0)
    assert arm.progress().finished == ()
    assert arm.state() is ArmState.NOT_RUNNING
