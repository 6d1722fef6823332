"""Limits of a rig, in its file under `limits`; those of a protocol: `protocols.protocol_limits`."""

from __future__ import annotations

from collections.abc import Iterator

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import PositiveMillimetres, PositiveNewtons, PositiveSpeed
from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.core.calibration import Calibration

_DEEPEST_MM = 50.0
"""Largest plausible depth of a press; no skin is thicker, and one given in metres is larger."""


class RigLimits(StrictModel):
    """Limits of this arm at this rig, whatever a protocol says."""

    depth: PositiveMillimetres
    speed: PositiveSpeed
    reach: PositiveMillimetres
    """Largest distance of the sensor's centre from the plate's centre."""
    force: PositiveNewtons | None = None
    """Largest force on the plate, in any direction, before the arm is stopped; needs a force
    sensor."""


def check_zero(calibration: Calibration, limits: RigLimits) -> Iterator[KeyedError]:
    """Hold what shifts depth zero against the limit of depth, which counts from depth zero.

    Teaching searches no deeper than that limit, so it writes no value that is refused here; but one
    that was typed wrongly would let the arm go deeper by as much.
    """
    most_mm = float(limits.depth)
    touch_mm = calibration.touch_depth
    if not 0.0 <= touch_mm <= most_mm:
        text = f"must be from 0 mm to limits.depth = {most_mm:g} mm: how deep a touch is noticed"
        yield KeyedError("calibration.touch_depth", f"{touch_mm:g} mm", text)
    if not abs(calibration.zero_mm) <= most_mm:
        text = f"is farther from the taught plane than limits.depth = {most_mm:g} mm: teach both"
        yield KeyedError("calibration.depth_zero.zero", f"{calibration.zero_mm:g} mm", text)


def check_depth_unit(limits: RigLimits) -> Iterator[KeyedError]:
    """Check that the limit of depth was not written in metres, as `arm_settings.check_units`."""
    depth_mm = float(limits.depth)
    if depth_mm > _DEEPEST_MM:
        text = (
            f"is deeper than {_DEEPEST_MM:g} mm, more than any skin is thick: write millimetres, "
            f"such as {depth_mm / 1000:g} mm"
        )
        yield KeyedError("limits.depth", f"{depth_mm:g} mm", text)
