"""Settings common to all devices of a kind, of any make; cheap to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel


class DriverSettings(StrictModel):
    """A device in a rig file. A driver's own settings fix `driver` to the driver's name."""

    driver: str
    """Name of the driver, as `sliplab rigs --drivers` lists it."""


class FrameCameraSettings(DriverSettings):
    """Settings that every frame camera has."""

    exposure_us: Annotated[float, Field(ge=1, le=1_000_000)] = 2000.0
    """Exposure, microseconds."""


class GripperSettings(DriverSettings):
    """Settings that every gripper has."""

    opening_mm: Annotated[float, Field(gt=0, le=1000)]
    """Opening at which the arm's depth is the depth in contact: that with which the contact plane
    was taught. Every trial begins with it."""
