"""Universal Robots arms: RTDE, dashboard, script port, and ur_rtde in a child process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.rigs.core.driver import ArmDriver, ArmScene, ForceSensorDriver
from sliplab.rigs.core.network import answers, arm_lock
from sliplab.rigs.devices.ur.settings import RTDE_PORT, UrSettings, UrWrenchSettings

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import Arm, ForceSensor
    from sliplab.rigs.core.fakes import FakeController


def _build(settings: UrSettings) -> Arm:
    from sliplab.rigs.devices.ur.driver import UrArm

    return UrArm(settings)


def _fake(settings: UrSettings, scene: ArmScene) -> FakeController:
    from sliplab.rigs.devices.ur.fake import FakeUr

    bit = 1 << settings.sync_input
    fake = FakeUr(
        settings.host,
        scene.motion,
        cycle_hz=settings.frequency_hz,
        digital_inputs=lambda t_s: bit if scene.sync(t_s) else 0,
        reach_mm=scene.reach_mm,
        clock=scene.clock,
    )
    if scene.load is not None:
        fake.program.tool_load = scene.load
    return fake


DRIVER = ArmDriver(
    name="ur",
    title="Universal Robots",
    settings=UrSettings,
    libraries=("rtde_control",),
    ping=lambda settings: answers(settings.host, RTDE_PORT),
    address=lambda settings: settings.host,
    locks=arm_lock,
    build=_build,
    fake=_fake,
)


def _build_wrench(settings: UrWrenchSettings, arm: Arm) -> ForceSensor:
    from sliplab.rigs.core.capabilities import RigError
    from sliplab.rigs.devices.ur.driver import UrArm
    from sliplab.rigs.devices.ur.wrench import UrWrench

    if not isinstance(arm, UrArm):
        raise RigError("force sensor", "ur_wrench needs the arm of driver: ur")
    return UrWrench(settings, arm)


WRENCH_DRIVER = ForceSensorDriver(
    name="ur_wrench",
    title="Universal Robots, its own wrench",
    settings=UrWrenchSettings,
    ping=lambda settings: None,  # the arm is looked for already
    build=_build_wrench,
    of_arm=True,
)
