"""Limits of a rig, in its file under `limits`; those of a protocol: `protocols.protocol_limits`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.program import Position
from sliplab.protocols.quantity import PositiveMillimetres, PositiveNewtons, PositiveSpeed
from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.core.arm_settings import ArmLimits
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


@dataclass(frozen=True)
class Motion:
    """A motion of a plan, and what needs it.

    Attributes:
        zeroed: depths count from depth zero, not from the taught plane.
    """

    to: Position
    what: str
    where: str
    speed_mm_s: float = 0.0
    turn_deg: float = 0.0
    zeroed: bool = True


def check_arm(
    limits: ArmLimits, calibration: Calibration, motions: Iterable[Motion]
) -> Iterator[KeyedError]:
    """Hold motions against the limits of the arm itself, as `core.guard` does for each segment.

    Depth zero is the calibrated one, from which what is touched off later differs little.
    """
    from sliplab.rigs.core.plate_frame import PlateFrame  # imports scipy

    plane, key = calibration.contact_plane, "devices.arm.limits"
    frame = own = PlateFrame.taught((plane.centre, plane.right, plane.above))
    if (plate := limits.plate) is not None:
        try:
            own = PlateFrame.taught((plate.centre_mm, plate.right_mm, plate.above_mm))
        except ValueError as error:
            yield KeyedError(f"{key}.plate", list(plate.centre_mm), str(error))
            return
    zeroed = frame.with_zero(calibration.zero_mm)
    for motion in motions:
        place = (zeroed if motion.zeroed else frame).pose(replace(motion.to, twist_deg=0.0))
        at = own.position(place.xyz_mm)
        xyz = place.xyz_mm if limits.frame == "base" else (at.x_mm, at.y_mm, at.depth_mm)
        found = [
            ("depth_mm", at.depth_mm, "mm beyond the taught plane", limits.depth_mm, 1),
            ("speed_mm_s", motion.speed_mm_s, "mm/s", limits.speed_mm_s, 1),
            ("tilt_deg", motion.turn_deg, "deg", limits.tilt_deg, 1),
        ]
        for axis, value, low, high in zip("xyz", xyz, limits.low_mm, limits.high_mm, strict=True):
            unit = f"mm in {axis} of the {limits.frame} frame"
            found += [("low_mm", value, unit, low, -1), ("high_mm", value, unit, high, 1)]
        for name, value, unit, limit, sign in found:
            if limit is not None and sign * (value - limit) > 1e-6:
                text = f"{motion.what} needs {value:g} {unit} {motion.where}"
                yield KeyedError(f"{key}.{name}", getattr(limits, name), text)


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
