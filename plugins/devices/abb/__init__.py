"""ABB arms on an IRC5 controller: motion programs with EGM poses."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.plugins.devices.abb.settings import AbbSettings
from sliplab.rigs.core.driver import ArmDriver, ArmScene, lazy
from sliplab.rigs.core.network import answers, arm_lock

if TYPE_CHECKING:
    from sliplab.rigs.core.fakes import FakeController


def _fake(settings: AbbSettings, scene: ArmScene) -> FakeController:
    from sliplab.plugins.devices.abb.fake import FakeAbb

    return FakeAbb(
        settings.host,
        settings.rws_port,
        ("127.0.0.1", settings.egm_port),
        scene.motion,
        egm_point=settings.egm_point,
        clock=scene.clock,
    )


LIBRARIES = ("abb_motion_program_exec", "abb_robot_client")

DRIVER = ArmDriver(
    name="abb",
    title="ABB, motion programs",
    settings=AbbSettings,
    libraries=LIBRARIES,
    ping=lambda settings: answers(settings.host, settings.rws_port),
    address=lambda settings: settings.host,
    locks=arm_lock,
    build=lazy("sliplab.plugins.devices.abb.driver:AbbArm"),
    fake=_fake,
)
