"""The lab stage: an arm of three axes that is driven by lines of text over TCP.

Imported whenever a rig file names it, by `sliplab plan` too: the driver itself is loaded when the
device is made.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.rigs.core.arm_settings import BaseArmSettings, Port, Triple
from sliplab.rigs.core.capabilities import Arm
from sliplab.rigs.core.driver import ArmDriver, ArmScene
from sliplab.rigs.core.fakes import FakeController
from sliplab.rigs.core.network import answers, arm_lock


class LabStageSettings(BaseArmSettings):
    """A stage of three axes behind a controller that speaks lines of text."""

    driver: Literal["lab_stage"] = "lab_stage"
    port: Port = 7300
    """TCP port of the controller."""
    tool_rotvec_deg: Triple = (0.0, 0.0, 0.0)
    """How the tool is mounted, a rotation vector in the base frame: the stage cannot turn it."""
    turn_deg: Annotated[float, Field(ge=0, le=10)] = 1.0
    """How far an asked orientation may differ from the mounted one, degrees."""


def build(settings: LabStageSettings) -> Arm:
    """Make the driver, not connected yet."""
    from lab_stage.driver import LabStage

    return LabStage(settings)


def fake(settings: LabStageSettings, scene: ArmScene) -> FakeController:
    """Make a fake controller at the address of the settings, not started yet."""
    from lab_stage.fake import FakeLabStage

    return FakeLabStage(settings.host, settings.port, scene.motion, scene.clock, scene.sync)


DRIVER = ArmDriver(
    name="lab_stage",
    title="Lab stage",
    settings=LabStageSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=arm_lock,
    build=build,
    twists=False,  # it has three linear axes
    fake=fake,
)
