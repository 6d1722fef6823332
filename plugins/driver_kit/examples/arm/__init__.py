"""Example arm: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Literal

from sliplab.rigs.core.arm_settings import BaseArmSettings, Port
from sliplab.rigs.core.capabilities import Arm
from sliplab.rigs.core.driver import ArmDriver, ArmScene
from sliplab.rigs.core.fakes import FakeController
from sliplab.rigs.core.network import answers, arm_lock


class ExampleArmSettings(BaseArmSettings):
    """An arm whose controller speaks lines of text over TCP."""

    driver: Literal["example_arm"] = "example_arm"
    port: Port = 7300
    """TCP port of the controller."""


def build(settings: ExampleArmSettings) -> Arm:
    """Make the driver, not connected yet."""
    from sliplab.plugins.driver_kit.examples.arm.driver import ExampleArm

    return ExampleArm(settings)


def fake(settings: ExampleArmSettings, scene: ArmScene) -> FakeController:
    """Make a fake controller at the address of the settings, not started yet."""
    from sliplab.plugins.driver_kit.examples.arm.fake import FakeExampleArm

    return FakeExampleArm(settings.host, settings.port, scene)


DRIVER = ArmDriver(
    name="example_arm",
    title="Example arm",
    settings=ExampleArmSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=arm_lock,
    build=build,
    fake=fake,
)
