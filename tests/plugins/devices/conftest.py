"""Fakes and the real drivers on them, each test on an address of its own; waiting is bounded."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

import pytest
from abb_robot_client._egm_protobuf import egm_pb2

from sliplab.plugins.devices import ur
from sliplab.plugins.devices.abb.driver import AbbArm
from sliplab.plugins.devices.abb.fake import FakeAbb
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.plugins.devices.basler.fake_live import emulate
from sliplab.plugins.devices.ur.driver import UrArm
from sliplab.plugins.devices.ur.fake import FakeUr
from sliplab.plugins.devices.ur.settings import UrSettings
from sliplab.rigs.core.capabilities import Arm, ArmFault, ArmState, Pose
from sliplab.rigs.core.pose import distance_mm, quaternion
from tests.plugins.devices.arms import LIMITS
from tests.rigs.waiting import own_address, until

MakeRobot = Callable[..., FakeUr]
MakeArm = Callable[..., UrArm]
MakeUr = Callable[..., tuple[UrArm, FakeUr]]
MakeAbb = Callable[..., tuple[AbbArm, FakeAbb]]
ABB_PORT, EGM_PORT = 8080, 6510


def ur_settings(host: str, **more: Any) -> UrSettings:
    """A quarter of the controller's rate is enough here, and kind to a busy machine."""
    return UrSettings(**{"host": host, "limits": LIMITS, "frequency_hz": 125, **more})


@pytest.fixture
def robot_of() -> Iterator[MakeRobot]:
    """Makes fakes, which are closed after the test."""
    with ExitStack() as stack:

        def make(**how: Any) -> FakeUr:
            return stack.enter_context(FakeUr(own_address(), **{"cycle_hz": 125, **how}))

        yield make


@pytest.fixture
def arm_on() -> Iterator[MakeArm]:
    """Makes drivers of fakes, which are closed after the test."""
    with ExitStack() as stack:

        def make(
            robot: FakeUr, connected: bool = True, measures: bool = False, **settings: Any
        ) -> UrArm:
            arm = ur.DRIVER.builder(measures)(ur_settings(robot.host, **settings))
            assert isinstance(arm, UrArm)
            stack.callback(arm.close)
            if connected:
                arm.connect()
            return arm

        yield make


@pytest.fixture
def ur_pair(robot_of: MakeRobot, arm_on: MakeArm) -> MakeUr:
    """Makes a UR fake and the driver on it; both are closed after the test."""

    def make(connected: bool = True, measures: bool = False, **how: Any) -> tuple[UrArm, FakeUr]:
        robot = robot_of(**how)
        return arm_on(robot, connected, measures), robot

    return make


def egm_message(number: int, t_s: float | None, pose: Pose) -> egm_pb2.EgmRobot:
    """A datagram of a controller that stands at `pose`; without a time if that is None."""
    message = egm_pb2.EgmRobot()
    message.header.seqno = number
    part = message.feedBack
    part.cartesian.pos.x, part.cartesian.pos.y, part.cartesian.pos.z = pose.xyz_mm
    orient = part.cartesian.orient
    orient.u0, orient.u1, orient.u2, orient.u3 = quaternion(pose)
    if t_s is not None:
        part.time.sec, part.time.usec = divmod(round(t_s * 1e6), 1_000_000)
    return message


def mm_after_kill(program: str, settings: str, robot: Any, limit_s: float) -> float:
    """Return the distance that a fake arm moves at 40 mm/s after its program is killed, mm."""
    with subprocess.Popen([sys.executable, "-c", program, settings]) as process:
        try:
            until(lambda: robot.pose().xyz_mm[1] > 5.0, 60.0)
        finally:
            process.send_signal(signal.SIGKILL)
    killed = robot.pose()
    until(lambda: not robot.moving(), limit_s)
    gone_mm = distance_mm(killed, robot.pose())
    print(f"simulated: {gone_mm:.1f} mm at 40 mm/s after the program was killed")
    return gone_mm


def abb_settings(host: str, **more: Any) -> AbbSettings:
    """A tool of 120 mm on an arm whose web services and poses are at the test's address."""
    ports = {"host": host, "rws_port": ABB_PORT, "egm_bind": host, "egm_port": EGM_PORT}
    tool = {"tcp_mm": (0, 0, 120), "mass_kg": 0.4}
    return AbbSettings(**{**ports, "limits": LIMITS, "tool": tool, **more})


def closed(arm: Arm) -> None:
    """Give an arm's connections back, whether or not it could be stopped in the test."""
    with suppress(ArmFault):
        arm.close()


def reconnect(arm: Arm) -> None:
    """Close the arm and connect again, as the next command at a rig would: it is ready then."""
    closed(arm)
    arm.connect()
    assert arm.state() is ArmState.READY


@pytest.fixture
def abb_pair() -> Iterator[MakeAbb]:
    """Makes an ABB fake and the driver on it; both are closed after the test."""
    with ExitStack() as stack:

        def make(connected: bool = True, arm: Any = None, **how: Any) -> tuple[AbbArm, FakeAbb]:
            host = own_address()
            robot = FakeAbb(host, ABB_PORT, (host, EGM_PORT), **{"cycle_hz": 125, **how})
            stack.enter_context(robot)
            made = AbbArm(abb_settings(host, **(arm or {})))
            stack.callback(closed, made)
            if connected:
                made.connect()
            return made, robot

        yield make


@pytest.fixture(scope="session")
def pylon_emulation() -> None:
    """pylon lists an emulated camera; before anything in this process has loaded it."""
    emulate(1)
