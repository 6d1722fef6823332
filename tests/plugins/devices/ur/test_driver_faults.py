"""The UR driver's reaction to each fault, within its timeout.

Bounds are held against the clock here with what a busy machine may add; `docs/arms.md` has what was
measured. The client is the real ur_rtde throughout.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from sliplab.plugins.devices.ur import control as ur_control
from sliplab.plugins.devices.ur import ports as ur_ports
from sliplab.plugins.devices.ur import settings
from sliplab.plugins.devices.ur.control import ControlError, ControlProcess
from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.plugins.devices.ur.fake_program import Safety
from sliplab.plugins.devices.ur.rtde import HEADER, SETUP_INPUTS
from sliplab.plugins.devices.ur.settings import RTDE_PORT
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Segment
from sliplab.rigs.core.fakes import HOME, PACKETS_LOST, Fault, Kind, Stage
from sliplab.rigs.core.pose import distance_mm
from tests.plugins.devices.arms import BUSY_S, SLIDE, at, fails, sliding
from tests.plugins.devices.conftest import MakeArm, MakeRobot, MakeUr, reconnect, ur_settings
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime

TARGET = at(15.0)


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("kind", "state"),
    [
        (Kind.PROTECTIVE_STOP, ArmState.PROTECTIVE_STOP),
        (Kind.EMERGENCY_STOP, ArmState.EMERGENCY_STOP),
        (Kind.REMOTE_OFF, ArmState.NOT_RUNNING),
        (Kind.SAFEGUARD_STOP, ArmState.PROTECTIVE_STOP),
        (Kind.PROGRAM_PAUSED, ArmState.NOT_RUNNING),
        (Kind.POWER_OFF, ArmState.NOT_RUNNING),
    ],
)
def test_a_stop_while_sliding_ends_the_path(ur_pair: MakeUr, kind: Kind, state: ArmState) -> None:
    arm, robot = ur_pair(faults=[Fault(kind, Stage.MOVING, after_mm=1.0)])
    arm.start(SLIDE)
    until(lambda: arm.progress().done, 5.0)
    assert arm.state() is state
    assert arm.progress().finished == ()
    assert not arm.progress().state.healthy
    until(lambda: not robot.program.program_running, 2.0)  # nothing is left that could go on
    where = robot.pose().xyz_mm[1]
    assert where == pytest.approx(1.0, abs=0.2)
    arm.stop()
    with pytest.raises(ArmFault):
        arm.start(SLIDE)


def test_connecting_again_unlocks_nothing_and_needs_a_person_first(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(faults=[Fault(Kind.PROTECTIVE_STOP, Stage.MOVING, after_mm=1.0)])
    arm.start(SLIDE)
    until(lambda: arm.progress().done, 5.0)
    with pytest.raises(ArmFault, match="unlock the stop at the pendant"):
        reconnect(arm)
    assert robot.program.safety is Safety.PROTECTIVE_STOP
    robot.unlock()
    where = robot.pose()
    reconnect(arm)
    assert distance_mm(robot.pose(), where) < 1e-6  # the interrupted move did not go on
    arm.start([Segment(TARGET, 40.0)])
    until(lambda: arm.progress().done, 5.0)
    assert len(arm.progress().finished) == 1


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_a_link_lost_while_sliding(ur_pair: MakeUr, kind: Kind) -> None:
    arm, robot = ur_pair(faults=[Fault(kind, Stage.MOVING, after_mm=1.0)])
    arm.start(SLIDE)
    until(lambda: robot.pose().xyz_mm[1] >= 1.0, 5.0)
    until(lambda: arm.state() is ArmState.DISCONNECTED, settings.SILENCE_S + BUSY_S)
    until(lambda: arm.progress().done, 2 * settings.PORT_S + BUSY_S)
    fails(arm.stop, 2 * settings.PORT_S, "cannot be reached to stop it")
    until(lambda: not robot.moving(), 1 / settings.WATCHDOG_HZ + BUSY_S)  # its own watchdog
    where = robot.pose()
    robot.restore_link()
    reconnect(arm)
    assert distance_mm(robot.pose(), where) < 1e-6  # the client did not send the move again


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
def test_a_link_lost_while_idle(ur_pair: MakeUr, kind: Kind) -> None:
    arm, robot = ur_pair()
    robot.inject(kind)
    until(lambda: arm.state() is ArmState.DISCONNECTED, settings.SILENCE_S + BUSY_S)
    fails(lambda: arm.start(SLIDE), settings.PORT_S, "does not answer")
    arm.stop()  # an arm that stood still needs no stopping
    robot.restore_link()
    until(lambda: not robot.program.program_running, 1 / settings.WATCHDOG_HZ + BUSY_S)
    reconnect(arm)


@pytest.mark.quick(1)
@pytest.mark.parametrize("kind", [Kind.LINK_CUT, Kind.SILENCE])
@pytest.mark.parametrize(
    ("stage", "within_s"),
    [
        (Stage.CONNECTING, settings.ANSWER_S),
        (Stage.CONTROL, ur_control.START_S),
        (Stage.UPLOADING, ur_control.START_S),
    ],
)
def test_a_link_lost_while_connecting_or_uploading(
    ur_pair: MakeUr,
    monkeypatch: pytest.MonkeyPatch,
    kind: Kind,
    stage: Stage,
    within_s: float,
) -> None:
    """The client would wait for ever in most of these; the child's bound is cut short here."""
    monkeypatch.setattr(ur_control, "START_S", 2.0)
    arm, robot = ur_pair(connected=False, faults=[Fault(kind, stage)])
    fails(arm.connect, min(within_s, 2.0) + 2 * settings.PORT_S, "its power|did not give control")
    assert arm.state() is ArmState.DISCONNECTED
    robot.restore_link()
    monkeypatch.undo()
    if robot.program.program_running:  # the script came through: a person ends it at the pendant
        fails(arm.connect, settings.ANSWER_S, "a program is already running on it")
        robot.inject(Kind.PROGRAM_END)
    reconnect(arm)


def test_a_controller_that_takes_commands_and_never_answers(ur_pair: MakeUr) -> None:
    """Its stream flows and its program says that it runs, but nothing happens any more."""
    arm, robot = ur_pair()
    robot.hang_program(True)
    took = fails(
        lambda: arm.start(SLIDE), settings.COMMAND_S + 2 * settings.PORT_S, "lost its control"
    )
    assert took >= settings.COMMAND_S
    assert not robot.program.program_running  # it was asked to stop by the dashboard
    robot.hang_program(False)
    reconnect(arm)


def test_a_dead_control_client_leaves_two_ways_to_stop(ur_pair: MakeUr) -> None:
    arm, robot = sliding(*ur_pair())
    arm._control.kill()
    began = time.monotonic()
    arm.stop()
    assert time.monotonic() - began < 2 * settings.PORT_S + settings.STILL_S + BUSY_S
    assert not robot.moving()


def test_remote_control_off_is_a_state_of_its_own(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False)
    robot.set_remote(False)
    fails(arm.connect, settings.ANSWER_S, "remote control off; switch the pendant")
    robot.set_remote(True)
    arm.connect()
    robot.set_remote(False)
    fails(lambda: arm.start(SLIDE), settings.PORT_S, "switch the pendant to remote control")
    assert arm.state() is ArmState.REMOTE_CONTROL_OFF
    robot.set_remote(True)
    arm.start(SLIDE)


def test_a_stopped_arm_is_not_taken_control_of(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False)
    robot.inject(Kind.PROTECTIVE_STOP)
    fails(arm.connect, settings.ANSWER_S, "unlock the stop at the pendant")
    assert robot.program.uploads == 0


def test_a_second_client_is_refused_and_the_first_slides_on(robot_of: Any, arm_on: MakeArm) -> None:
    robot = robot_of()
    first = arm_on(robot)
    first.start([Segment(TARGET, 10.0)])
    second = arm_on(robot, connected=False)
    fails(second.connect, settings.ANSWER_S, "a program is already running on it")
    until(lambda: first.progress().done, 5.0)
    assert len(first.progress().finished) == 1


def test_registers_that_are_taken_are_told(robot_of: MakeRobot) -> None:
    """Somebody who writes the registers without a program: a PLC, or a client that starts up."""
    robot = robot_of()
    taker = socket.create_connection((robot.host, RTDE_PORT), 2.0)
    with taker:
        body = b"input_int_register_0"
        taker.sendall(HEADER.pack(HEADER.size + len(body), SETUP_INPUTS) + body)
        assert taker.recv(100)
        arm = UrArm(ur_settings(robot.host))
        fails(arm.connect, ur_control.START_S, "another client has control of it.*EtherNet/IP")


def test_a_bad_call_is_an_error_and_the_client_lives_on(robot_of: Any, arm_on: MakeArm) -> None:
    robot = robot_of()
    arm_on(robot, connected=False)
    control = ControlProcess(robot.host, 125)
    try:
        with pytest.raises(ControlError, match="not within"):
            control.call("moveL", [0.4, 0, 0.3, 3.14, 0, 0], 99.0, 1.0, True, within_s=2.0)
        assert control.call("isConnected", within_s=2.0)
    finally:
        control.close()
    with pytest.raises(ControlError):
        control.call("isConnected", within_s=2.0)


@pytest.mark.parametrize("paused", [False, True])
def test_somebody_elses_program_is_not_taken_over(robot_of: Any, arm_on: Any, paused: bool) -> None:
    """A paused one waits to be resumed; the control client would end it without a word."""
    robot = robot_of()
    ur_ports.send_script(robot.host, "def palletise():\n  sleep(1000)\nend\n", 1.0)
    until(lambda: robot.program.foreign, 2.0)
    if paused:
        robot.inject(Kind.PROGRAM_PAUSED)
    arm = arm_on(robot, connected=False)
    what = "a program is already " + ("paused" if paused else "running") + " on it"
    fails(arm.connect, settings.ANSWER_S, f"{what}; end it at the pendant first")
    assert robot.program.foreign
    assert robot.program.program_running
    assert robot.program.uploads == 0


def test_an_arm_without_power_is_said_to_have_none(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair(connected=False)
    robot.inject(Kind.POWER_OFF)
    fails(arm.connect, settings.ANSWER_S, r"not switched on \(power off\)")
    robot.restore()
    arm.connect()
    assert arm.state() is ArmState.READY


def test_a_slider_that_is_moved_while_sliding_ends_the_path(ur_pair: MakeUr) -> None:
    arm, robot = sliding(*ur_pair())
    robot.set_slider(0.5)
    until(lambda: arm._run.done, 2.0)
    fails(arm.progress, 0.0, "slider is at 50%, so the move was too slow")
    arm.stop()
    assert not robot.moving()


@pytest.mark.quick(1)
@pytest.mark.parametrize("moving", [False, True])
def test_a_controller_clock_that_falls_back_ends_the_stream(ur_pair: MakeUr, moving: bool) -> None:
    """A segment that began before and ended after would have a negative length."""
    arm, robot = ur_pair()
    if moving:
        arm.start(SLIDE)
        until(lambda: robot.pose().xyz_mm[1] > 0.5, 5.0)
    robot.inject(Kind.CLOCK_BACK)
    until(lambda: arm.state() is ArmState.DISCONNECTED, 1.0)
    until(lambda: arm.progress().done, 2.0)
    assert arm.progress().finished == ()
    arm.stop()  # by its dashboard, and seen on a new connection
    assert not robot.moving()
    fails(lambda: arm.start(SLIDE), settings.PORT_S, "clock jumped back by 4.9")
    until(lambda: not robot.program.program_running, 1 / settings.WATCHDOG_HZ + BUSY_S)
    reconnect(arm)


def test_a_stream_of_nonsense_is_a_lost_one(ur_pair: MakeUr) -> None:
    arm, robot = sliding(*ur_pair())
    robot.program.joints_deg[2] = float("nan")
    until(lambda: arm.state() is ArmState.DISCONNECTED, 1.0)
    fails(arm.stop, 2 * settings.PORT_S + 2 * settings.STILL_S, "cannot be confirmed at rest")
    assert not robot.moving()


def test_packets_that_are_missing_are_counted(ur_pair: MakeUr) -> None:
    arm, robot = ur_pair()
    assert arm.describe()["poses_missing"] == 0
    robot.inject(Kind.PACKETS_LOST)
    until(lambda: arm.describe()["poses_missing"] > 0, 2.0)
    assert arm.describe()["poses_missing"] == PACKETS_LOST
    assert arm.state() is ArmState.READY


def test_a_link_lost_as_the_move_begins_is_no_arm_at_rest(
    ur_pair: MakeUr, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The last packet still shows the arm at rest, and yet it moves."""
    arm, robot = ur_pair()
    monkeypatch.setattr(arm, "_take", lambda packet: None)  # none of those after the start comes
    arm.start(SLIDE)
    robot.inject(Kind.LINK_CUT)
    until(lambda: arm.progress().done, 2 * settings.PORT_S + BUSY_S)
    fails(arm.stop, 2 * settings.PORT_S, "cannot be reached to stop it")
    fails(arm.stop, 2 * settings.PORT_S, "cannot be reached to stop it")
    arm.close()
    fails(arm.stop, 2 * settings.PORT_S, "cannot be reached to stop it")
    robot.restore_link()
    arm.stop()  # now it is confirmed at rest
    assert not robot.moving()


def test_a_stop_after_close_still_stops(ur_pair: MakeUr) -> None:
    arm, robot = sliding(*ur_pair())
    arm.close()
    arm.stop()
    assert not robot.moving()


def test_a_follower_that_fails_says_why_and_stops_the_arm(
    ur_pair: MakeUr, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, robot = ur_pair()

    def broken(pose: Pose) -> bool:
        raise TypeError("of whatever kind")

    monkeypatch.setattr(arm, "_is_at", broken)
    arm.start([Segment(Pose((400.0, 1.0, 300.0), HOME.rotvec_deg), 10.0), *SLIDE])
    until(lambda: arm._run.done, 5.0)
    fails(arm.progress, 0.0, "its path was aborted: TypeError")
    assert not robot.moving()


def test_a_dashboard_that_sends_no_line_is_given_up() -> None:
    """Such as a print server on that port."""
    host = own_address()
    with socket.create_server((host, ur_ports.DASHBOARD_PORT)) as door:
        thread = threading.Thread(target=lambda: _flood(door))
        thread.start()
        with pytest.raises(ur_ports.PortError, match="not a line of text"):
            ur_ports.dashboard(host, "is in remote control", 5.0)
        thread.join(5.0)


def _flood(door: socket.socket) -> None:
    link, _ = door.accept()
    with link, contextlib.suppress(OSError):
        for _ in range(1 << 14):
            link.sendall(b"x" * 4096)


DRIVES = """
import sys
from sliplab.plugins.devices.ur.settings import UrSettings
from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.rigs.core.capabilities import Pose, Segment
arm = UrArm(UrSettings.model_validate_json(sys.argv[1]))
arm.connect()
arm.start([Segment(Pose((400.0, 95.0, 300.0), (180.0, 0.0, 0.0)), 20.0)])
print(arm._control._child.pid, flush=True)
sys.stdin.read()
"""


@contextlib.contextmanager
def driving(robot: Any) -> Iterator[Any]:
    """Start a program that drives the arm; it prints the number of its control client."""
    arm_settings = ur_settings(robot.host).model_dump_json()
    program = subprocess.Popen(
        [sys.executable, "-c", DRIVES, arm_settings], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert program.stdin is not None
    with program.stdout, program.stdin:
        yield program


@pytest.mark.parametrize("whole", [False, True])
def test_the_arm_of_a_killed_program_stops(robot_of: MakeRobot, whole: bool) -> None:
    """The control client stops it when its program dies; the watchdog when both die."""
    robot = robot_of()
    with driving(robot) as program:
        client = int(program.stdout.readline())
        until(lambda: robot.pose().xyz_mm[1] > 2.0, 5.0)
        for pid in (client, program.pid)[not whole :]:
            os.kill(pid, signal.SIGKILL)
        killed_mm = robot.pose().xyz_mm[1]
        program.wait(5.0)
    until(lambda: not robot.moving(), BUSY_S)
    way_mm = robot.pose().xyz_mm[1] - killed_mm
    guaranteed_s = 1 / settings.WATCHDOG_HZ if whole else 0.5
    assert way_mm < 20.0 * (guaranteed_s + 1.0)
    print(f"{'both' if whole else 'program'} killed at 20 mm/s: {way_mm:.2f} mm")


def test_the_arm_of_a_suspended_program_stops(robot_of: MakeRobot) -> None:
    """The control client lives on, and would keep the controller's watchdog content."""
    robot = robot_of()
    with driving(robot) as program:
        program.stdout.readline()
        until(lambda: robot.pose().xyz_mm[1] > 2.0, 5.0)
        try:
            program.send_signal(signal.SIGSTOP)
            suspended_mm = robot.pose().xyz_mm[1]
            until(lambda: not robot.moving(), ur_control.SILENT_S + BUSY_S)
            assert robot.pose().xyz_mm[1] - suspended_mm < 20.0 * (ur_control.SILENT_S + 1.0)
        finally:
            program.kill()
        program.wait(5.0)
