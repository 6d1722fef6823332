"""The driver of the RAPID socket server on its fake: what it can do, and what it cannot."""

from __future__ import annotations

import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.abb_socket import device as abb_socket
from sliplab.plugins.abb_socket import driver
from sliplab.plugins.abb_socket.driver import AbbSocketArm
from sliplab.plugins.abb_socket.fake import FakeRapidServer
from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.plugins.abb_socket.wire import RapidError, RapidSocket, ServerCommand
from sliplab.rigs.core.capabilities import Arm, ArmState, RigError, Segment
from sliplab.rigs.core.fake_motion import StraightMotion
from sliplab.rigs.core.fakes import HOME, Fault, Kind, Stage
from sliplab.rigs.core.guard import SpeedError
from sliplab.rigs.core.pose import distance_mm
from tests.plugins.devices.arms import BUSY_S, LIMITS, SLIDE, at, fails
from tests.plugins.devices.conftest import closed, mm_after_kill, reconnect
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime

MakePair = Callable[..., tuple[AbbSocketArm, FakeRapidServer]]


def settings(host: str, **more: Any) -> AbbSocketSettings:
    tool = {"tcp_mm": (0, 0, 120)}
    return AbbSocketSettings(**{"host": host, "limits": LIMITS, "tool": tool, **more})


@pytest.fixture
def pair() -> Iterator[MakePair]:
    """Makes a fake and the driver on it; both are closed after the test."""
    with ExitStack() as stack:

        def make(connected: bool = True, **how: Any) -> tuple[AbbSocketArm, FakeRapidServer]:
            robot = stack.enter_context(FakeRapidServer(own_address(), **how))
            arm = AbbSocketArm(settings(robot.host))
            stack.callback(closed, arm)
            if connected:
                arm.connect()
            return arm, robot

        yield make


@pytest.mark.quick(1)
@pytest.mark.parametrize("speed", [1.6, pytest.param(6.0, id="6.0, ten times as fast as 0.6")])
def test_a_slide_in_pieces_is_at_its_speed_where_they_run_into_each_other(
    pair: MakePair, speed: float
) -> None:
    """Nothing here can make a slow slide quick: its clock is the host's."""
    arm, _ = pair()
    arm.read_poses()
    arm.start([Segment(at(5.0), speed)])
    until(lambda: arm.progress().done, 20.0)
    (span,) = arm.progress().finished
    chunk = arm.read_poses()
    assert len(chunk) >= 5 / speed / 0.25
    margin = (span[1] - span[0]) // 20
    inside = (chunk.t_ns >= span[0] + margin) & (chunk.t_ns <= span[1] - margin)
    t_s, xyz = (chunk.t_ns[inside] - span[0]) / 1e9, chunk.xyz_mm[inside]
    assert np.polyfit(t_s, xyz[:, 1], 1)[0] == pytest.approx(speed, rel=0.02)
    assert np.ptp(xyz[:, [0, 2]], axis=0).max() < 0.05
    assert arm.pose().xyz_mm == pytest.approx(at(5.0).xyz_mm, abs=1e-3)


def test_it_is_an_arm_that_sets_its_tool(pair: MakePair) -> None:
    arm, robot = pair()
    assert isinstance(abb_socket.DRIVER.build(settings("127.0.0.1")), Arm)
    assert arm.state() is ArmState.READY
    assert distance_mm(arm.pose(), HOME) < 1e-3
    assert robot.tool.xyz_mm == (0, 0, 120)
    assert abs(arm.now_ns() - time.monotonic_ns()) < 1e9
    assert len(arm.read_pulses()) == 0


def test_segments_follow_each_other_and_guards_hold(pair: MakePair) -> None:
    arm, robot = pair()
    with pytest.raises(SpeedError):
        arm.start([Segment(at(5.0), 51.0)])
    with pytest.raises(RigError, match="empty"):
        arm.start([])
    assert not robot.moving()
    arm.start([Segment(at(3.0), 20.0), Segment(at(0.0), 20.0)])
    with pytest.raises(RigError, match="still moving"):
        arm.start(SLIDE)
    until(lambda: arm.progress().done, 5.0)
    assert len(arm.progress().finished) == 2


def test_a_stop_waits_for_one_piece_and_no_more(pair: MakePair) -> None:
    arm, robot = pair()
    arm.start(SLIDE)
    until(lambda: robot.pose().xyz_mm[1] > 1.0, 5.0)
    began = robot.pose().xyz_mm[1]
    arm.stop()
    assert not robot.moving()
    # three pieces, on a busy machine
    assert robot.pose().xyz_mm[1] - began < 3 * 1.6 * arm.stopping_s(1.6)
    assert arm.progress().finished == ()
    assert arm.state() is ArmState.READY


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE, Kind.PROTECTIVE_STOP])
def test_a_move_that_is_not_answered_is_a_fault(
    pair: MakePair, monkeypatch: pytest.MonkeyPatch, kind: Kind
) -> None:
    monkeypatch.setattr(driver, "OVERTIME_S", 1.0)
    arm, robot = pair(faults=[Fault(kind, Stage.MOVING, after_mm=0.1)])
    arm.start(SLIDE)
    until(lambda: arm.state() is ArmState.DISCONNECTED, 2.0 + BUSY_S)
    until(lambda: arm.progress().done, 1.0)
    fails(lambda: arm.start(SLIDE), 0.1, "disconnected")
    fails(arm.stop, 4 * driver.ANSWER_S, "is not confirmed at rest .* moved on for at most 0.25 s")
    robot.restore()
    reconnect(arm)
    assert arm.state() is ArmState.READY


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_a_link_lost_while_connecting_or_idle(pair: MakePair, kind: Kind) -> None:
    arm, robot = pair(connected=False, faults=[Fault(kind, Stage.CONNECTING)])
    fails(arm.connect, 2 * driver.ANSWER_S, "the server accepts one client")
    robot.restore()
    arm.connect()
    robot.inject(kind)
    fails(arm.pose, driver.ANSWER_S, "check it, then connect again")
    assert arm.state() is ArmState.DISCONNECTED


def test_a_second_client_waits_and_is_told_why(pair: MakePair) -> None:
    arm, robot = pair()
    second = AbbSocketArm(settings(robot.host))
    fails(second.connect, 2 * driver.ANSWER_S, "the server accepts one client")
    arm.close()
    second.connect()
    second.close()


def test_a_lost_link_in_mid_motion_ends_with_its_piece(pair: MakePair) -> None:
    arm, robot = pair()
    arm.start([Segment(at(90.0), 40.0)])
    until(lambda: robot.pose().xyz_mm[1] > 5.0, 5.0)
    cut = robot.pose()
    robot.drop_connections()
    until(lambda: arm._run.done, BUSY_S)
    arm.stop()  # sees it stand, over a new connection
    assert not robot.moving()
    assert distance_mm(cut, robot.pose()) < 40.0 * 0.25 + 1.0
    assert arm.state() is ArmState.DISCONNECTED
    arm.stop()
    reconnect(arm)
    assert arm.state() is ArmState.READY


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.PROTECTIVE_STOP])
def test_a_stop_that_nobody_can_confirm_is_a_fault(
    pair: MakePair, monkeypatch: pytest.MonkeyPatch, kind: Kind
) -> None:
    monkeypatch.setattr(driver, "OVERTIME_S", 1.0)
    arm, robot = pair()
    arm.start([Segment(at(90.0), 40.0)])
    until(lambda: robot.pose().xyz_mm[1] > 5.0, 5.0)
    robot.inject(kind)
    for action in (arm.stop, arm.stop, arm.close):
        fails(action, 2.0 + 4 * driver.ANSWER_S, "is not confirmed at rest")


KILLED = """
import sys, threading
from sliplab.plugins.abb_socket.driver import AbbSocketArm
from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.rigs.core.capabilities import Pose, Segment
arm = AbbSocketArm(AbbSocketSettings.model_validate_json(sys.argv[1]))
arm.connect()
arm.start([Segment(Pose((400.0, 90.0, 300.0), (180.0, 0.0, 0.0)), 40.0)])
threading.Event().wait()
"""


def test_a_path_thread_that_fails_says_so(pair: MakePair, monkeypatch: pytest.MonkeyPatch) -> None:
    arm, robot = pair()
    monkeypatch.setattr(driver, "between", lambda *_: 1 / 0)
    arm.start(SLIDE)
    until(lambda: arm._run.done, BUSY_S)
    fails(arm.progress, 0.0, "its path was aborted: ZeroDivisionError")
    arm.stop()
    assert not robot.moving()


def test_an_arm_stands_a_piece_after_the_program_was_killed(pair: MakePair) -> None:
    _, robot = pair(connected=False)
    given = settings(robot.host).model_dump_json()
    gone_mm = mm_after_kill(KILLED, given, robot, BUSY_S)
    assert gone_mm < 40.0 * 0.25 + 1.0


@pytest.mark.parametrize(
    ("answer", "match"),
    [
        (struct.pack(">H7f", 1, math.nan, 0, 0, 1, 0, 0, 0), "a number that is not finite"),
        (struct.pack(">H7f", 1, 0, 0, math.inf, 1, 0, 0, 0), "a number that is not finite"),
        (struct.pack(">H7f", 1, 0, 0, 0, 0, 0, 0, 0), "norm is not 1"),
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "begins with 18516, not 0 or 1"),
        (struct.pack(">H2f", 1, 0, 0), "no answer to POSE"),
    ],
)
def test_an_answer_that_makes_no_sense_is_an_error(answer: bytes, match: str) -> None:
    with socket.create_server((own_address(), 0)) as server:
        link = RapidSocket(*server.getsockname(), 1.0)
        try:
            client, _ = server.accept()
            with client:
                client.sendall(answer)
                with pytest.raises(RapidError, match=match):
                    link.ask(ServerCommand.POSE, within_s=0.5)
        finally:
            link.close()


def test_an_address_where_nothing_listens_is_a_fault() -> None:
    fails(AbbSocketArm(settings(own_address())).connect, driver.ANSWER_S, "no connection")


def test_what_the_server_refuses_is_an_error(pair: MakePair) -> None:
    _, robot = pair(connected=False)
    link = RapidSocket(robot.host, robot.port, 1.0)
    try:
        assert "RAPID socket server" in link.info(1.0)
        assert len(link.ask(ServerCommand.JOINTS, within_s=1.0)) == 6
        with pytest.raises(RapidError, match="refused MOVE_JOINTS"):
            link.ask(ServerCommand.MOVE_JOINTS, (0.0,) * 6, within_s=1.0)
        with pytest.raises(RapidError, match="refused SET_WORK_OBJECT"):
            link.ask(
                ServerCommand.SET_WORK_OBJECT, (1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), within_s=1.0
            )
    finally:
        link.close()
    with pytest.raises(ValueError, match="clock_jump is not simulated"):
        robot.inject(Kind.CLOCK_BACK)


def test_pose_that_the_arm_cannot_have_reached_is_a_fault(pair: MakePair) -> None:
    arm, robot = pair()
    robot.motion = StraightMotion(at(50_000.0))
    fails(arm.read_poses, driver.ANSWER_S, "one that the arm cannot have reached")
    assert arm.state() is ArmState.DISCONNECTED
