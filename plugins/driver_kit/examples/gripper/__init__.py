"""Example gripper: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Any, Literal

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.arm_settings import Port
from sliplab.rigs.core.capabilities import Gripper
from sliplab.rigs.core.device_settings import GripperSettings
from sliplab.rigs.core.driver import FakeGripper, GripperDriver, GripperScene
from sliplab.rigs.core.gripper_range import GripperRange
from sliplab.rigs.core.network import answers

RANGE = GripperRange(
    opening_mm=(0.0, 80.0), speed_mm_s=(20.0, 100.0), force_n=(5.0, 60.0), step_mm=0.1
)
"""The manufacturer's ratings."""


class ExampleGripperSettings(GripperSettings):
    """A gripper that speaks lines of text over TCP."""

    driver: Literal["example_gripper"] = "example_gripper"
    host: Host = "127.0.0.1"
    """Address of the gripper."""
    port: Port = 7800
    """TCP port of the gripper."""


def build(settings: ExampleGripperSettings) -> Gripper:
    """Make the driver, not connected yet."""
    from sliplab.plugins.driver_kit.examples.gripper.driver import ExampleGripper

    return ExampleGripper(settings)


def fake(settings: ExampleGripperSettings, scene: GripperScene) -> FakeGripper:
    """Serve a fake on a free port."""
    from sliplab.plugins.driver_kit.examples.gripper.fake import FakeExampleGripper

    return FakeExampleGripper(scene)


def reach(settings: ExampleGripperSettings, address: Any) -> ExampleGripperSettings:
    """Return settings that reach a fake."""
    return settings.model_copy(update={"host": address[0], "port": address[1]})


DRIVER = GripperDriver(
    name="example_gripper",
    title="Example gripper",
    settings=ExampleGripperSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=lambda settings: {f"gripper-{settings.host}-{settings.port}": "the gripper"},
    build=build,
    range=lambda settings: RANGE,
    fake=fake,
    reach=reach,
)
