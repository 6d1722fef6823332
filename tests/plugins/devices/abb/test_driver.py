"""The ABB driver on a fake through the real clients: slides, streams, faults, bounds."""

from __future__ import annotations

import socket
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sliplab.plugins.devices import abb
from sliplab.plugins.devices.abb import settings
from sliplab.plugins.devices.abb.driver import AbbArm
from sliplab.plugins.devices.abb.program import TURN_DEG_S
from sliplab.plugins.devices.abb.rws import REQUEST_S, START_REQUESTS
from sliplab.rigs.core.capabilities import Arm, ArmState, Pose, RigError, Segment
from sliplab.rigs.core.fakes import HOME, Fault, Kind, Stage
from sliplab.rigs.core.guard import WorkspaceError
from sliplab.rigs.core.plate_frame import turned_about_z
from sliplab.rigs.core.pose import distance_mm
from tests.plugins.devices.arms import BUSY_S, SLIDE, at, fails
from tests.plugins.devices.conftest import EGM_PORT, MakeAbb, abb_settings, reconnect
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime


def within(span: tuple[int, int], t_ns: np.ndarray) -> Any:
    """Times in a span, without a twentieth of it at either end."""
    margin = (span[1] - span[0]) // 20
    return (t_ns >= span[0] + margin) & (t_ns <= span[1] - margin)


@pytest.mark.parametrize("speed", [pytest.param(0.6, marks=pytest.mark.long), 1.6])
def test_a_slide_is_straight_and_at_its_speed(abb_pair: MakeAbb, speed: float) -> None:
    arm, _ = abb_pair(rate=5.0, cycle_hz=50)  # 25 s of controller time at 0.6 mm/s
    arm.read_poses()
    arm.start([Segment(at(15.0), speed)])
    until(lambda: arm.progress().done, 20.0)
    (span,) = arm.progress().finished
    chunk = arm.read_poses()
    inside = within(span, chunk.t_ns)
    t_s, xyz = (chunk.t_ns[inside] - span[0]) / 1e9, chunk.xyz_mm[inside]
    assert np.polyfit(t_s, xyz[:, 1], 1)[0] == pytest.approx(speed, rel=0.005)
    assert np.ptp(xyz[:, [0, 2]], axis=0).max() < 0.05
    assert (span[1] - span[0]) / 1e9 == pytest.approx(15 / speed, rel=0.01)


def test_a_twist_is_on_the_spot_and_at_its_speed(abb_pair: MakeAbb) -> None:
    """A turn about the tool's z axis of 20 degrees at 4 deg/s."""
    arm, _ = abb_pair(rate=5.0, cycle_hz=50)
    arm.read_poses()
    turned = Pose(HOME.xyz_mm, turned_about_z(HOME.rotvec_deg, 20.0))
    arm.start([Segment(turned, 10.0, 4.0)])
    until(lambda: arm.progress().done, 20.0)
    (span,) = arm.progress().finished
    chunk = arm.read_poses()
    inside = within(span, chunk.t_ns)
    t_s = (chunk.t_ns[inside] - span[0]) / 1e9
    assert np.ptp(chunk.xyz_mm, axis=0).max() < 1e-3
    begin = Rotation.from_rotvec(HOME.rotvec_deg, degrees=True)
    angle = begin.inv() * Rotation.from_rotvec(chunk.rotvec_deg[inside], degrees=True)
    speed = np.polyfit(t_s, angle.as_rotvec(degrees=True)[:, 2], 1)[0]
    assert speed == pytest.approx(4.0, rel=0.01)
    assert (span[1] - span[0]) / 1e9 == pytest.approx(20 / 4.0, rel=0.05)


def test_a_turn_on_a_short_way_is_slow(abb_pair: MakeAbb) -> None:
    """29 degrees in a move of 0.2 mm at 10 mm/s, in which the controller turns the tool too."""
    arm, _ = abb_pair(rate=2.0, cycle_hz=50)
    arm.read_poses()
    x, y, z = HOME.xyz_mm
    arm.start([Segment(Pose((x, y, z + 0.2), turned_about_z(HOME.rotvec_deg, 29.0)), 10.0)])
    until(lambda: arm.progress().done, 20.0)
    assert len(arm.progress().finished) == 1
    chunk = arm.read_poses()
    turned = Rotation.from_rotvec(chunk.rotvec_deg, degrees=True)
    steps = np.degrees((turned[:-1].inv() * turned[1:]).magnitude())
    assert (steps / np.diff(chunk.t_ns) * 1e9).max() == pytest.approx(TURN_DEG_S, rel=0.1)


def test_it_is_an_arm_that_sets_its_tool(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    assert isinstance(abb.DRIVER.build(abb_settings("127.0.0.1")), Arm)
    assert arm.state() is ArmState.READY
    assert distance_mm(arm.pose(), HOME) < 1e-3
    assert robot.tool.xyz_mm == pytest.approx((0, 0, 120))
    assert robot.tool_mass_kg == pytest.approx(0.4)
    assert len(arm.read_pulses()) == 0


def test_a_path_of_segments_is_followed_from_rest_to_rest(abb_pair: MakeAbb) -> None:
    arm, _ = abb_pair()
    arm.start([Segment(at(5.0), 20.0), Segment(at(0.0), 10.0)])
    until(lambda: arm.progress().done, 10.0)
    first, second = arm.progress().finished
    assert first[1] < second[0]
    assert distance_mm(arm.pose(), HOME) < 0.05


def test_egm_that_tells_the_flange_is_noticed_and_may_be_set(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair(connected=False, egm_point="flange")
    fails(arm.connect, settings.FIRST_POSE_S, r"120\.0 mm apart: set `egm_point`")
    right = AbbArm(abb_settings(robot.host, egm_point="flange"))
    try:
        right.connect()
        assert distance_mm(right.pose(), HOME) < 1e-3
    finally:
        right.close()


def test_a_stop_in_a_slide(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    arm.start(SLIDE)
    until(lambda: robot.pose().xyz_mm[1] > 0.5, 5.0)
    arm.stop()
    assert not robot.moving()
    assert arm.progress().done
    assert arm.progress().finished == ()
    arm.start([Segment(at(0.0), 20.0)])
    until(lambda: arm.progress().done, 5.0)
    assert len(arm.progress().finished) == 1


def test_what_the_guard_forbids_is_never_sent(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    with pytest.raises(WorkspaceError):
        arm.start([Segment(at(101.0), 1.0)])
    with pytest.raises(RigError, match="empty"):
        arm.start([])
    assert not robot.running


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("kind", "state"),
    [
        (Kind.PROTECTIVE_STOP, ArmState.PROTECTIVE_STOP),
        (Kind.EMERGENCY_STOP, ArmState.EMERGENCY_STOP),
        (Kind.REMOTE_OFF, ArmState.REMOTE_CONTROL_OFF),
        (Kind.PROGRAM_END, ArmState.READY),
    ],
)
def test_a_stop_from_outside_ends_the_path(abb_pair: MakeAbb, kind: Kind, state: ArmState) -> None:
    arm, robot = abb_pair(faults=[Fault(kind, Stage.MOVING, after_mm=0.5)])
    arm.start(SLIDE)
    until(lambda: arm.progress().done, 5.0)
    assert arm.state() is state
    assert arm.progress().finished == ()
    arm.stop()
    if state is not ArmState.READY:
        fails(lambda: reconnect(arm), 7 * REQUEST_S, state.value)
        robot.restore()
        reconnect(arm)


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_a_link_lost_while_sliding_is_told_and_cannot_be_stopped(abb_pair: Any, kind: Kind) -> None:
    arm, robot = abb_pair(arm={"watchdog_s": None})
    arm.start(SLIDE)
    until(lambda: robot.pose().xyz_mm[1] > 0.5, 5.0)
    robot.inject(kind)
    lost_s = settings.FAILURES * (settings.MONITOR_S + 2 * REQUEST_S)
    fails(arm.stop, 4 * REQUEST_S, "cannot be reached to stop it")
    until(lambda: arm.state() is ArmState.DISCONNECTED, lost_s + BUSY_S)
    assert arm.progress().done
    assert robot.moving()  # nothing on the controller knows


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
@pytest.mark.parametrize("stage", [Stage.CONNECTING, Stage.UPLOADING])
def test_a_link_lost_while_connecting_or_uploading(abb_pair: Any, kind: Kind, stage: Stage) -> None:
    arm, robot = abb_pair(connected=False, faults=[Fault(kind, stage)])
    fails(arm.connect, (7 + START_REQUESTS) * REQUEST_S, "check its power")
    assert arm.state() is ArmState.DISCONNECTED
    robot.restore()
    arm.connect()
    assert arm.state() is ArmState.READY


def test_a_link_lost_while_idle(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    robot.inject(Kind.LINK_CUT)
    lost_s = settings.FAILURES * (settings.MONITOR_S + 2 * REQUEST_S)
    until(lambda: arm.state() is ArmState.DISCONNECTED, lost_s + BUSY_S)
    fails(lambda: arm.start(SLIDE), REQUEST_S, "check power and network")
    arm.stop()


def test_an_address_where_nothing_listens_is_a_fault() -> None:
    arm = AbbArm(abb_settings(own_address()))
    fails(arm.connect, REQUEST_S, "check its power")


def test_poses_that_do_not_come_are_a_fault(abb_pair: MakeAbb) -> None:
    arm, _ = abb_pair(connected=False, arm={"egm_port": EGM_PORT + 1})
    fails(arm.connect, settings.FIRST_POSE_S + 7 * REQUEST_S, "no pose came on UDP port 6511")


def test_a_second_client_is_refused(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    arm.start(SLIDE)
    second = AbbArm(abb_settings(robot.host))
    fails(second.connect, REQUEST_S, "UDP port 6510 cannot be opened")  # on one host
    second = AbbArm(abb_settings(robot.host, egm_port=EGM_PORT + 1))
    fails(second.connect, (7 + START_REQUESTS) * REQUEST_S, "must be stopped")  # on another
    assert robot.moving()


def test_a_wrong_password_is_a_fault(abb_pair: MakeAbb) -> None:
    arm, _ = abb_pair(connected=False, arm={"password": "wrong"})
    fails(arm.connect, 7 * REQUEST_S, "401")


def test_sockets_are_given_back(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    arm.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind((robot.host, EGM_PORT))
