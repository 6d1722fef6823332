"""Robotiq 2F-85 and 2F-140 grippers on a Universal Robots arm, by the socket of their URCap."""

from __future__ import annotations

from typing import Any

from sliplab.plugins.reflex.robotiq_2f.settings import Robotiq2fSettings
from sliplab.rigs.core.driver import GripperDriver, lazy
from sliplab.rigs.core.network import answers

_range = lazy("sliplab.plugins.reflex.robotiq_2f.protocol:range_of")
_fake = lazy("sliplab.plugins.reflex.robotiq_2f.fake:FakeRobotiq")


def _locks(settings: Robotiq2fSettings) -> dict[str, str]:
    host = settings.host.lower()
    return {f"gripper-{host}": f"the gripper at {host}"}


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
    build=lazy("sliplab.plugins.reflex.robotiq_2f.driver:Robotiq2f"),
    range=lambda settings: _range(settings.model),
    fake=lambda settings, scene: _fake(settings.model, scene),
    reach=_reach,
)
