"""Limits that no trial of a protocol may exceed; those of a rig: `rigs.rig_limits`."""

from __future__ import annotations

from sliplab.protocols.quantity import (
    Millimetres,
    PositiveDegrees,
    PositiveDegreesPerSecond,
    PositiveMillimetres,
    PositiveSeconds,
    PositiveSpeed,
)
from sliplab.protocols.yaml_file import StrictModel, rule

MAX_CREEP_MM_S = 1.0
"""Highest speed towards a surface that is searched for: the arm continues while a touch is noticed,
deeper than the limits at a higher one, and depth zero is off by as much."""


class AxisLimits(StrictModel):
    """Allowed interval of one coordinate, in plate coordinates."""

    low: Millimetres
    high: Millimetres

    @rule
    def _ordered(self) -> AxisLimits:
        if not self.low < self.high:
            raise ValueError("'low' must be below 'high'")
        return self


class Workspace(StrictModel):
    """The box that the sensor's centre must stay in, in plate coordinates."""

    x: AxisLimits
    y: AxisLimits


class ProtocolLimits(StrictModel):
    """Limits that no trial of this protocol may exceed, checked before anything moves."""

    depth: PositiveMillimetres
    speed: PositiveSpeed
    clearance: PositiveMillimetres
    workspace: Workspace
    duration: PositiveSeconds
    twist: PositiveDegrees | None = None
    """Largest angle about the plate's normal; needed where the motion has a twist."""
    twist_speed: PositiveDegreesPerSecond | None = None
    """The same of its speed."""
