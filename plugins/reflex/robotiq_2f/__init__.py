"""Robotiq 2F-85 and 2F-140 grippers on a Universal Robots arm, by the socket of their URCap."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sliplab.plugins.reflex.robotiq_2f.settings import Robotiq2fSettings
from sliplab.rigs.core.driver import FakeGripper, GripperDriver, GripperScene
from sliplab.rigs.core.network import answers

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import Gripper
    from sliplab.rigs.core.gripper_range import GripperRange


def _build(settings: Robotiq2fSettings) -> Gripper:
    from sliplab.plugins.reflex.robotiq_2f.driver import Robotiq2f

    return Robotiq2f(settings)


def _range(settings: Robotiq2fSettings) -> GripperRange:
    from sliplab.plugins.reflex.robotiq_2f.protocol import range_of

    return range_of(settings.model)


def _locks(settings: Robotiq2fSettings) -> dict[str, str]:
    host = settings.host.lower()
    return {f"gripper-{host}": f"the gripper at {host}"}


def _fake(settings: Robotiq2fSettings, scene: GripperScene) -> FakeGripper:
    from sliplab.plugins.reflex.robotiq_2f.fake import FakeRobotiq

    return FakeRobotiq(settings.model, scene)


def _reach(settings: Robotiq2fSettings, address: Any) -> Robotiq2fSettings:
    host, port = address
    return settings.model_copy(update={"host": host, "port": port})


DRIVER = GripperDriver(
    name="robotiq_2f",
    title="Robotiq 2F",
    settings=Robotiq2fSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: settings.host,
    locks=_locks,
    build=_build,
    range=_range,
    fake=_fake,
    reach=_reach,
)
