"""The maker-independent client ur_rtde takes the fake for a real controller.

The client runs in a process of its own: its constructors hold Python's global lock, so a fake
in the same process could never answer them.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

import pytest

from sliplab.plugins.devices.ur import ports as ur_ports
from sliplab.plugins.devices.ur.fake import FakeUr
from sliplab.plugins.devices.ur.rtde import RtdeError, RtdeReader
from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fakes import HOME, Kind
from tests.rigs.waiting import own_address, until

pytestmark = pytest.mark.realtime

CLIENT_S = 30.0
HEAD = """
import json, sys, time
host, home = sys.argv[1], [0.4, 0.0, 0.3, 3.141592653589793, 0.0, 0.0]
from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface
said = {}
"""


@pytest.fixture
def robot() -> Iterator[FakeUr]:
    with FakeUr(own_address()) as stand_in:
        yield stand_in


def client(robot: FakeUr, script: str) -> dict[str, object]:
    """Run a script that uses the real client, and return its output."""
    line = (sys.executable, "-c", HEAD + script + "\nprint('SAID', json.dumps(said))", robot.host)
    done = subprocess.run(line, capture_output=True, text=True, timeout=CLIENT_S, check=False)
    lines = [line for line in done.stdout.splitlines() if line.startswith("SAID ")]
    assert lines, done.stderr
    found: dict[str, object] = json.loads(lines[-1][5:])
    return found


def test_the_real_client_moves_stops_and_sets_things(robot: FakeUr) -> None:
    script = """
receive = RTDEReceiveInterface(host)
control = RTDEControlInterface(host)
said["mode"] = receive.getRobotMode()
said["moved"] = control.moveL([0.4, 0.0, 0.295, 3.141592653589793, 0.0, 0.0], 0.04, 0.5)
late = time.monotonic() + 5.0  # its packets may come after the answer
while abs(receive.getActualTCPPose()[2] - 0.295) > 1e-4 and time.monotonic() < late:
    pass
said["z"] = receive.getActualTCPPose()[2]
said["taken"] = control.moveL(home, 0.001, 0.5, True)
said["running"] = control.getAsyncOperationProgressEx().isAsyncOperationRunning()
control.stopL(5.0, True)
said["set"] = [control.setTcp([0, 0, 0.1, 0, 0, 0]), control.setPayload(0.5, [0, 0, 0])]
said["near"] = control.isPoseWithinSafetyLimits(home)
said["far"] = control.isPoseWithinSafetyLimits([2.0, 0, 0, 0, 0, 0])
"""
    found = client(robot, script)
    assert found["mode"] == 7
    assert (found["moved"], found["taken"], found["set"]) == (True, True, [True, True])
    assert found["z"] == pytest.approx(0.295, abs=1e-4)
    assert (found["near"], found["far"]) == (True, False)
    assert robot.program.tcp == pytest.approx([0, 0, 0.1, 0, 0, 0])
    assert robot.program.payload_kg == 0.5


def test_registers_belong_to_the_first_client(robot: FakeUr) -> None:
    script = """
first = RTDEControlInterface(host)
try:
    RTDEControlInterface(host)
except RuntimeError as error:
    said["refused"] = str(error)
said["first"] = first.moveL(home, 0.1, 1.0)
"""
    found = client(robot, script)
    assert "already in use" in str(found["refused"])
    assert found["first"] is True


def test_a_protective_stop_lasts_until_somebody_unlocks_it(robot: FakeUr) -> None:
    script = """
control = RTDEControlInterface(host)
said["triggered"] = control.triggerProtectiveStop()
said["refused"] = control.moveL(home, 0.1, 1.0)
"""
    found = client(robot, script)
    assert found["refused"] is False
    assert ur_ports.dashboard(robot.host, "safetystatus", 1.0) == "Safetystatus: PROTECTIVE_STOP"
    said = ur_ports.dashboard(robot.host, "unlock protective stop", 1.0)
    assert said == "Protective stop releasing"
    assert ur_ports.dashboard(robot.host, "safetystatus", 1.0) == "Safetystatus: NORMAL"


def test_the_watchdog_ends_the_program_of_a_client_that_went_silent(robot: FakeUr) -> None:
    script = """
import os
control = RTDEControlInterface(host)
control.setWatchdog(5.0)
control.moveL([0.4, 0.05, 0.3, 3.141592653589793, 0.0, 0.0], 0.001, 0.5, True)
print("SAID {}", flush=True)
os._exit(0)  # as if it had been killed
"""
    client(robot, script)
    until(lambda: not robot.moving(), 2.0)
    assert not robot.program.program_running
    assert robot.pose().xyz_mm[1] < 5.0


def test_scripts_end_what_runs_and_may_stop_the_arm(robot: FakeUr) -> None:
    robot.motion.move(Pose((400.0, 50.0, 300.0), HOME.rotvec_deg), 10.0, 100.0, robot.clock.now_s())
    until(lambda: robot.pose().xyz_mm[1] > 1.0, 2.0)
    ur_ports.send_script(robot.host, "stopl(1.0)\n", 1.0)
    until(lambda: not robot.moving(), 2.0)
    assert robot.pose().xyz_mm[1] < 49.0


def test_a_silent_controller_takes_connections_and_says_nothing(robot: FakeUr) -> None:
    robot.inject(Kind.SILENCE)
    with pytest.raises(ur_ports.PortError):
        ur_ports.dashboard(robot.host, "running", 0.2)
    robot.restore_link()
    assert ur_ports.dashboard(robot.host, "running", 1.0) == "Program running: false"


def test_in_local_control_nothing_from_outside_runs(robot: FakeUr) -> None:
    robot.set_remote(False)
    assert ur_ports.dashboard(robot.host, "is in remote control", 1.0) == "false"
    assert ur_ports.dashboard(robot.host, "stop", 1.0) != "Stopped"


def test_it_runs_as_a_process_of_its_own() -> None:
    host = own_address()
    process = subprocess.Popen([sys.executable, "-m", "sliplab.plugins.devices.ur.fake", host])
    try:
        until(lambda: _answers(host), 20.0)
    finally:
        process.kill()
        process.wait(5.0)


def _answers(host: str) -> bool:
    try:
        return ur_ports.dashboard(host, "robotmode", 1.0) == "Robotmode: RUNNING"
    except ur_ports.PortError:
        return False


@pytest.mark.parametrize("call", ["speedL([0.01, 0, 0, 0, 0, 0], 0.1, 0.1)", "forceModeStop()"])
def test_a_command_that_is_not_simulated_fails(robot: FakeUr, call: str) -> None:
    script = f"""
control = RTDEControlInterface(host)
control.{call}
late = time.monotonic() + 5.0
while control.isProgramRunning() and time.monotonic() < late:
    pass
said["runs"] = control.isProgramRunning()
"""
    found = client(robot, script)
    assert found["runs"] is False
    assert robot.program.refused
    assert robot.pose() == HOME


@pytest.mark.parametrize("request_", ["play", "pause", "power on", "unlock protective stop"])
def test_a_request_that_cannot_be_done_says_so(robot: FakeUr, request_: str) -> None:
    assert ur_ports.dashboard(robot.host, request_, 1.0) == f"Failed to execute: {request_}"


def test_outputs_that_it_does_not_know_are_not_found(robot: FakeUr) -> None:
    reader = RtdeReader(robot.host, 1.0, 1.0)
    with pytest.raises(RtdeError, match="does not know actual_mood"):
        reader.open(["timestamp", "actual_mood"], 125)


@pytest.mark.parametrize(
    ("kind", "safety", "mode"),
    [
        (Kind.SAFEGUARD_STOP, "SAFEGUARD_STOP", "RUNNING"),
        (Kind.EMERGENCY_STOP, "EMERGENCY_STOP", "RUNNING"),
        (Kind.POWER_OFF, "NORMAL", "POWER_OFF"),
    ],
)
def test_it_says_what_state_it_is_in(robot: FakeUr, kind: Kind, safety: str, mode: str) -> None:
    robot.inject(kind)
    assert ur_ports.dashboard(robot.host, "safetystatus", 1.0) == f"Safetystatus: {safety}"
    assert ur_ports.dashboard(robot.host, "robotmode", 1.0) == f"Robotmode: {mode}"
    ur_ports.send_script(robot.host, "def other():\nend\n", 1.0)
    assert ur_ports.dashboard(robot.host, "running", 1.0) == "Program running: false"
