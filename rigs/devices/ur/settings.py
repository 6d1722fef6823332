"""Settings of a Universal Robots arm, as rig files give them; cheap to import."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.rigs.core.arm_settings import BaseArmSettings, Positive
from sliplab.rigs.core.device_settings import DriverSettings


class UrSettings(BaseArmSettings):
    """A Universal Robots e-Series arm, PolyScope 5.6 to 5.x, in remote control.

    Its ports are fixed: 30004 RTDE, 29999 dashboard, 30003 scripts. Segments are not blended: the
    arm comes to rest between two of them, so each has constant speed between its ramps.
    """

    driver: Literal["ur"] = "ur"
    acceleration_mm_s2: Positive = 100.0
    """Acceleration at the start and the end of each segment."""
    frequency_hz: Annotated[int, Field(ge=10, le=500)] = 500
    """Rate of the pose stream; 500 is the controller's native rate."""
    sync_input: Annotated[int, Field(ge=0, le=17)] = 0
    """Bit of `actual_digital_input_bits` with the sync line (0 to 7: standard inputs)."""


class UrWrenchSettings(DriverSettings):
    """The wrench at the tool that a Universal Robots e-Series controller measures."""

    driver: Literal["ur_wrench"] = "ur_wrench"
    bias: Literal["trial", "session", "never"] = "trial"
    """When the present load becomes zero: before every trial while the sensor is clear of the
    plate, once when it is connected, or never."""
