"""Limits of a rig, in its file under `limits`; those of a protocol: `protocols.protocol_limits`."""

from __future__ import annotations

from sliplab.protocols.quantity import PositiveMillimetres, PositiveNewtons, PositiveSpeed
from sliplab.protocols.yaml_file import StrictModel


class RigLimits(StrictModel):
    """Limits of this arm at this rig, whatever a protocol says."""

    depth: PositiveMillimetres
    speed: PositiveSpeed
    reach: PositiveMillimetres
    """Largest distance of the sensor's centre from the plate's centre."""
    force: PositiveNewtons | None = None
    """Largest force on the plate, in any direction, before the arm is stopped; needs a force
    sensor."""
