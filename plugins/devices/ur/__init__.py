"""Universal Robots arms: RTDE, dashboard, script port, and ur_rtde in a child process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.plugins.devices.ur.settings import RTDE_PORT, UrSettings, UrWrenchSettings
from sliplab.rigs.core.driver import ArmDriver, ArmScene, ForceSensorDriver, lazy
from sliplab.rigs.core.network import answers, arm_lock

if TYPE_CHECKING:
    from sliplab.rigs.core.fakes import FakeController


def _fake(settings: UrSettings, scene: ArmScene) -> FakeController:
    from sliplab.plugins.devices.ur.fake import FakeUr

    bit = 1 << settings.sync_input
    return FakeUr(
        settings.host,
        scene.motion,
        cycle_hz=settings.frequency_hz,
        digital_inputs=lambda t_s: bit if scene.sync(t_s) else 0,
        reach_mm=scene.reach_mm,
        clock=scene.clock,
        tool_load=scene.load,
    )


DRIVER = ArmDriver(
    name="ur",
    title="Universal Robots",
    settings=UrSettings,
    libraries=("rtde_control",),
    ping=lambda settings: answers(settings.host, RTDE_PORT),
    address=lambda settings: settings.host,
    locks=arm_lock,
    build=lazy("sliplab.plugins.devices.ur.driver:UrArm"),
    build_measuring=lazy("sliplab.plugins.devices.ur.driver:measuring_arm"),
    fake=_fake,
)


WRENCH_DRIVER = ForceSensorDriver(
    name="ur_wrench",
    title="Universal Robots, its own wrench",
    settings=UrWrenchSettings,
    ping=lambda settings: None,  # the arm is looked for already
    build=lazy("sliplab.plugins.devices.ur.wrench:UrWrench"),
    of_arm=True,
)
