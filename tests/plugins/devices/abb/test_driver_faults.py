"""The ABB driver when something is wrong: lost links, hostile packets, other speeds, no host."""

from __future__ import annotations

import contextlib
import math
import socket
import threading
import time
from typing import Any

import pytest
from abb_robot_client._egm_protobuf import egm_pb2

from sliplab.plugins.devices.abb import driver, settings
from sliplab.plugins.devices.abb.driver import AbbArm
from sliplab.plugins.devices.abb.rws import REQUEST_S, WebRefused, WebServices
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Segment
from sliplab.rigs.core.fakes import HOME, PACKETS_LOST, Kind
from sliplab.rigs.core.pose import distance_mm
from tests.plugins.devices.arms import BUSY_S, SLIDE, at, fails, sliding
from tests.plugins.devices.conftest import (
    EGM_PORT,
    MakeAbb,
    abb_settings,
    egm_message,
    mm_after_kill,
    reconnect,
)
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime

FAR = Pose((9999.0, 9999.0, 9999.0), HOME.rotvec_deg)
LOST_S = settings.FAILURES * (settings.MONITOR_S + 2 * REQUEST_S) + BUSY_S


def packet(pose: Pose, number: int, t_s: float) -> bytes:
    data: bytes = egm_message(number, t_s, pose).SerializeToString()
    return data


def send(sender: str, to: str, data: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((sender, 0))
        link.sendto(data, (to, EGM_PORT))


# -- connecting --------------------------------------------------------------------------------


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_connecting_again_finds_a_loss_that_nobody_noticed(abb_pair: MakeAbb, kind: Kind) -> None:
    arm, robot = abb_pair()
    arm.connect()  # one that answers is kept
    assert arm.state() is ArmState.READY
    robot.inject(kind)
    with pytest.raises(ArmFault):
        arm.connect()
    assert arm.state() is ArmState.DISCONNECTED
    robot.restore()
    reconnect(arm)


@pytest.mark.long
def test_connecting_again_stops_an_arm_that_was_lost_on_its_way(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair(arm={"watchdog_s": 1.0}))
    robot.inject(Kind.SILENCE)
    with contextlib.suppress(ArmFault):  # where no pose confirms that its watchdog stopped it
        arm.connect()
    until(lambda: not robot.moving(), LOST_S)
    assert robot.watchdog_stops == 1
    assert arm.state() is ArmState.DISCONNECTED


# -- stopping ------------------------------------------------------------------------------


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_a_stop_after_a_lost_link_was_noticed_is_a_fault(abb_pair: MakeAbb, kind: Kind) -> None:
    arm, robot = sliding(*abb_pair(arm={"watchdog_s": None}))
    robot.inject(kind)
    until(lambda: arm.state() is ArmState.DISCONNECTED, LOST_S)
    fails(arm.stop, 8 * REQUEST_S, "its path of 9 s runs to its end: press its emergency stop")
    assert robot.moving()
    fails(arm.close, 8 * REQUEST_S, "cannot be reached to stop it")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind((robot.host, EGM_PORT))  # given back all the same


def test_a_stop_takes_a_new_connection_if_the_old_one_is_dead(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.drop_connections()
    arm.stop()
    assert not robot.moving()
    assert robot.watchdog_stops == 0


def test_a_path_thread_that_fails_says_so_and_stops_the_arm(
    abb_pair: MakeAbb, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, robot = sliding(*abb_pair())
    monkeypatch.setattr(arm, "_abort_reason", lambda: 1 / 0)
    until(lambda: arm._run.done, BUSY_S)
    fails(arm.progress, 0.0, "its path was aborted: ZeroDivisionError")
    until(lambda: not robot.moving(), settings.STOPPED_S + BUSY_S)


@pytest.mark.long
def test_a_path_whose_start_was_not_answered_may_run(abb_pair: MakeAbb) -> None:
    """The controller takes the start and is never heard of again."""
    arm, robot = abb_pair(arm={"watchdog_s": None})
    robot.mute_after_start = True
    fails(lambda: arm.start(SLIDE), 25 * REQUEST_S, "did not accept the path")
    assert robot.running
    fails(arm.stop, 8 * REQUEST_S, "cannot be reached to stop it")


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_the_controller_stops_the_arm_when_the_link_is_lost(abb_pair: MakeAbb, kind: Kind) -> None:
    arm, robot = sliding(*abb_pair())
    robot.inject(kind)
    until(lambda: robot.watchdog_stops == 1, 1.0 + BUSY_S)
    assert not robot.running
    until(lambda: not robot.moving(), 1.0)
    fails(arm.stop, 8 * REQUEST_S, "its controller stops it 1 s after the last beat")
    robot.restore()
    reconnect(arm)
    arm.stop()


@pytest.mark.long
def test_poses_alone_can_show_that_the_controller_has_stopped_it(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.web_on = False
    arm.stop()
    assert robot.watchdog_stops == 1
    assert not robot.moving()


@pytest.mark.long
def test_stop_does_not_wait_for_a_path_that_is_being_sent(abb_pair: MakeAbb) -> None:
    """And the arm does not move after it."""
    arm, robot = abb_pair()
    robot.slow(0.2)  # of REQUEST_S: a busy machine has the rest
    starting = threading.Thread(target=arm.start, args=(SLIDE,))
    starting.start()
    until(lambda: arm._may_move, 10 * REQUEST_S)
    began = time.monotonic()
    arm.stop()
    assert time.monotonic() - began < 6 * REQUEST_S + settings.STOPPED_S + BUSY_S
    starting.join(25 * REQUEST_S)
    assert not starting.is_alive()
    assert arm.state() is ArmState.READY
    assert not robot.running
    assert robot.pose().xyz_mm[1] < 2.0


KILLED = """
import sys, threading
from sliplab.plugins.devices.abb.driver import AbbArm
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.rigs.core.capabilities import Pose, Segment
arm = AbbArm(AbbSettings.model_validate_json(sys.argv[1]))
arm.connect()
arm.start([Segment(Pose((400.0, 90.0, 300.0), (180.0, 0.0, 0.0)), 40.0)])
threading.Event().wait()
"""


def test_the_controller_stops_the_arm_when_the_program_is_killed(abb_pair: MakeAbb) -> None:
    _, robot = abb_pair(connected=False)
    arm_settings = abb_settings(robot.host).model_dump_json()
    gone_mm = mm_after_kill(KILLED, arm_settings, robot, 2.0 + BUSY_S)
    assert robot.watchdog_stops == 1
    assert 40.0 * 0.5 < gone_mm < 40.0 * 1.3


@pytest.mark.long
def test_a_stop_for_want_of_beats_is_told(abb_pair: MakeAbb) -> None:
    arm, _ = sliding(*abb_pair())
    arm._watchdog.pause()
    until(lambda: arm._run.done, 1.0 + BUSY_S)
    fails(arm.progress, 0.0, "was stopped by its controller's watchdog: no heartbeat")
    arm.start([Segment(at(0.0), 20.0)])  # watched again
    until(lambda: arm.progress().done, 5.0)
    assert len(arm.progress().finished) == 1


def test_a_controller_without_the_watchdog_must_be_accepted_in_so_many_words(abb_pair: Any) -> None:
    arm, robot = abb_pair(connected=False, watchdog=False)
    fails(arm.connect, 10 * REQUEST_S, r"load docs/rapid/sliplab_watchdog\.mod.*watchdog_s: null")
    without = AbbArm(abb_settings(robot.host, watchdog_s=None))
    try:
        without.connect()
        assert any("runs to its end" in note for note in without.health().notes)
    finally:
        without.close()


# -- poses ---------------------------------------------------------------------------------


def test_malformed_packets_do_not_end_the_pose_stream(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    arm.start([Segment(at(8.0), 4.0)])
    until(lambda: robot.pose().xyz_mm[1] > 0.5, 5.0)
    t_s = robot.clock.now_s()
    broken = [b"", b"\xff" * 40, packet(Pose((math.nan, 0.0, 0.0), HOME.rotvec_deg), 1, t_s)]
    empty = egm_pb2.EgmRobot()
    empty.ParseFromString(packet(HOME, 1, t_s))
    empty.feedBack.cartesian.orient.u0 = empty.feedBack.cartesian.orient.u1 = 0.0
    empty.feedBack.cartesian.orient.u2 = empty.feedBack.cartesian.orient.u3 = 0.0
    for data in [*broken, empty.SerializeToString()]:
        send(robot.host, robot.host, data)
    until(lambda: arm.progress().done, 5.0 + BUSY_S)
    assert len(arm.progress().finished) == 1
    assert distance_mm(arm.pose(), at(8.0)) < 0.05
    assert any("packets_malformed 4" in note for note in arm.health().notes)


def test_packets_of_other_senders_are_not_believed(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    send(own_address(), robot.host, packet(FAR, 1_000_000, robot.clock.now_s() + 1))
    until(lambda: arm.describe()["packets_of_others"] == 1, BUSY_S)
    assert distance_mm(arm.pose(), HOME) < 1e-3
    assert (arm.read_poses().xyz_mm < 1000).all()


def test_poses_that_stay_away_in_mid_motion_stop_the_arm(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.egm_on = False
    until(lambda: arm._run.done, settings.SILENCE_S + BUSY_S)
    fails(arm.progress, 0.0, "sent no pose for 0.* s while it moved")
    until(lambda: not robot.moving(), settings.STOPPED_S + BUSY_S)
    assert robot.pose().xyz_mm[1] < 14.0


def test_packets_without_time_are_refused(abb_pair: MakeAbb) -> None:
    arm, _ = abb_pair(connected=False, egm_time=False)
    fails(arm.connect, settings.FIRST_POSE_S, "carry no time.*RobotWare 6.07 or newer is needed")


def test_a_clock_that_falls_back_ends_the_path(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.inject(Kind.CLOCK_BACK)
    until(lambda: arm.state() is ArmState.DISCONNECTED, BUSY_S)
    until(lambda: not robot.moving(), settings.STOPPED_S + BUSY_S)
    until(lambda: arm._run.done, BUSY_S)
    fails(arm.progress, 0.0, r"clock jumped back by .* its path was aborted")
    fails(lambda: arm.start(SLIDE), 0.0, r"clock jumped back by (4\.9|5\.0)\d+ s")
    reconnect(arm)


def test_lost_packets_are_in_the_record(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    before = arm.describe()["poses_missing"]
    robot.inject(Kind.PACKETS_LOST)
    until(lambda: arm.describe()["poses_missing"] >= before + PACKETS_LOST, 1.0 + BUSY_S)


# -- speed ratio, states -------------------------------------------------------------------


def test_a_speed_ratio_below_100_percent_is_refused(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    robot.speed_percent = 50.0
    fails(lambda: arm.start(SLIDE), 10 * REQUEST_S, "speed ratio is 50 %.*100 %")
    assert not robot.running
    arm.close()
    fails(arm.connect, 10 * REQUEST_S, "speed ratio is 50 %")


def test_a_speed_ratio_changed_in_mid_motion_stops_the_arm(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.speed_percent = 25.0
    until(lambda: arm._run.done, driver.STATUS_S + BUSY_S)
    fails(arm.progress, 0.0, "speed ratio set to 25 % while it moved")
    until(lambda: not robot.moving(), settings.STOPPED_S + BUSY_S)


def test_a_program_of_somebody_else_is_neither_run_nor_ended(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair(connected=False)
    robot.pointer = "palletising"
    fails(arm.connect, 14 * REQUEST_S, "another user.s program paused in module palletising")
    robot.pointer, robot.entry = "motion_program_exec", "main"
    fails(
        arm.connect, 14 * REQUEST_S, "task T_ROB1 with the entry routine main, so that starting it"
    )
    assert not robot.running
    robot.entry = "Motion_Program_Main"
    arm.connect()
    assert arm.state() is ArmState.READY


def test_motors_that_are_switched_off_end_the_path(abb_pair: MakeAbb) -> None:
    arm, robot = sliding(*abb_pair())
    robot.inject(Kind.POWER_OFF)
    until(lambda: arm.progress().done, driver.STATUS_S + BUSY_S)
    assert arm.state() is ArmState.NOT_RUNNING
    arm.stop()


# -- web services --------------------------------------------------------------------------


@pytest.mark.long
def test_sessions_are_logged_out_of(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair()
    for _ in range(5):
        reconnect(arm)
    assert robot.sessions <= 3
    arm.close()
    assert robot.sessions == 0


@pytest.mark.long
def test_a_controller_that_takes_its_time_to_answer_works(abb_pair: MakeAbb) -> None:
    arm, robot = abb_pair(answer_s=0.6)
    arm.start([Segment(at(5.0), 5.0)])
    until(lambda: arm.progress().done, 20.0)
    assert len(arm.progress().finished) == 1
    arm.start([Segment(at(0.0), 0.5)])
    until(lambda: robot.pose().xyz_mm[1] < 4.8, 5.0)
    arm.stop()
    assert not robot.moving()
    assert robot.watchdog_stops == 0
    arm.close()
    assert robot.sessions == 0


def test_the_stand_in_refuses_what_it_does_not_simulate(abb_pair: MakeAbb) -> None:
    _, robot = abb_pair(connected=False)
    web = WebServices(abb_settings(robot.host))
    try:
        for ask in (
            lambda: web._ask(lambda: web._rws.set_controller_state("motoron")),
            lambda: web._ask(lambda: web._rws.set_speedratio(50)),
            lambda: web._ask(lambda: web._rws.get_robtarget(tool="tool7")),
            lambda: web.write_signal("sliplab_echo", 3.0),
            lambda: web.read_signal("do_gripper"),
        ):
            with pytest.raises(WebRefused):
                ask()
    finally:
        web.close()
