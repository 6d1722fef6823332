"""Settings of a Robotiq 2F gripper, as a rig file gives them; cheap to import."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.device_settings import GripperSettings

Model = Literal["2F-85", "2F-140"]


class Robotiq2fSettings(GripperSettings):
    """A Robotiq 2F gripper, wired to a Universal Robots controller that runs its URCap."""

    driver: Literal["robotiq_2f"] = "robotiq_2f"
    host: Host
    """Address of the arm's controller."""
    port: int = Field(default=63352, ge=1, le=65535)
    """TCP port of the URCap."""
    model: Model = "2F-85"
    answer_s: float = Field(default=1.0, gt=0, le=10)
    """Time limit of each answer."""
