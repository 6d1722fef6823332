"""Declaration of the driver; cheap to import."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.plugins.abb_socket.settings import AbbSocketSettings
from sliplab.rigs.core.driver import ArmDriver, ArmScene, lazy
from sliplab.rigs.core.network import answers, arm_lock

if TYPE_CHECKING:
    from sliplab.rigs.core.fakes import FakeController


def _fake(settings: AbbSocketSettings, scene: ArmScene) -> FakeController:
    from sliplab.plugins.abb_socket.fake import FakeRapidServer

    return FakeRapidServer(settings.host, settings.port, motion=scene.motion, clock=scene.clock)


DRIVER = ArmDriver(
    name="abb_socket",
    title="ABB, RAPID",
    settings=AbbSocketSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: settings.host,
    locks=arm_lock,
    build=lazy("sliplab.plugins.abb_socket.driver:AbbSocketArm"),
    twists=False,  # it rests between the pieces of a turn, whose zones are too small
    fake=_fake,
)
