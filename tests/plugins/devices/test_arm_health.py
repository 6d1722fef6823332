"""Health reports of arms through the vendors' interfaces; silence is an error."""

from __future__ import annotations

import pytest

from sliplab.plugins.abb_socket.driver import AbbSocketArm
from sliplab.plugins.abb_socket.fake import INFO, FakeRapidServer
from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.plugins.devices.abb.driver import AbbArm
from sliplab.plugins.devices.abb.fake import FakeAbb
from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.plugins.devices.ur.fake import VERSION
from sliplab.rigs.core.capabilities import ArmFault, DeviceHealth
from sliplab.rigs.core.fakes import Kind
from tests.patching import loose
from tests.plugins.devices.arms import LIMITS
from tests.plugins.devices.conftest import MakeArm, MakeRobot
from tests.rigs.waiting import own_address

pytestmark = pytest.mark.realtime


def test_a_universal_robot(robot_of: MakeRobot, arm_on: MakeArm) -> None:
    robot = robot_of()
    arm = arm_on(robot, connected=False, sync_input=3)
    found = arm.health()
    assert isinstance(found, DeviceHealth)
    assert (found.device, found.model, found.serial) == ("arm", "UR5", "20205500000")
    assert ".".join(map(str, VERSION)) in found.firmware
    assert found.notes == ("in remote control", "sync line on digital input 3")
    robot.set_remote(False)
    assert arm.health().notes[0] == "NOT remote control"
    robot.inject(Kind.SILENCE)
    with pytest.raises(ArmFault, match="check its power and network"):
        arm.health()


def test_an_abb_by_its_web_services() -> None:
    host = own_address()
    settings = loose(AbbSettings)(host=host, rws_port=8080, egm_bind=host, limits=LIMITS)
    with FakeAbb(host, 8080, (host, settings.egm_port)) as robot:
        arm = AbbArm(settings)
        with pytest.raises(ArmFault, match="cannot report its health"):
            arm.health()
        arm.connect()
        try:
            found = arm.health()
            assert (found.model, found.serial) == ("IRB120 stand-in", "120-000000")
            assert found.firmware == "RobotWare 6.08.00.01"
            assert found.notes[:2] == ("mode AUTO", "controller motoron")
            assert found.notes[2] == "stopped by its controller 1 s after this computer fails"
            assert found.notes[3].startswith("poses_missing ")
            robot.inject(Kind.SILENCE)
            with pytest.raises(ArmFault, match="do not answer"):
                arm.health()
        finally:
            arm.close()


def test_an_abb_behind_a_socket_server() -> None:
    host = own_address()
    with FakeRapidServer(host):
        arm = AbbSocketArm(loose(AbbSocketSettings)(host=host, limits=LIMITS))
        arm.connect()
        try:
            assert arm.health().model == INFO.decode()
        finally:
            arm.close()
