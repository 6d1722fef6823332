"""Settings that all real arms share, as rig files give them; cheap to import.

Names carry the unit: numbers for one make of arm follow its maker's conventions, and belong to the
rig, not to the protocol.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import StrictModel, rule
from sliplab.rigs.core.address import Host
from sliplab.rigs.core.device_settings import DriverSettings

Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
Triple = tuple[Finite, Finite, Finite]
Port = Annotated[int, Field(ge=1, le=65535)]


class PlaneSettings(StrictModel):
    """The plate as three touched points in the arm's base frame, for limits that follow it."""

    centre_mm: Triple
    right_mm: Triple
    above_mm: Triple


class ArmLimits(StrictModel):
    """Limits of the arm, checked before every move, whatever a protocol says."""

    low_mm: Triple
    high_mm: Triple
    """Corners of the box that the tool centre point may not leave."""
    frame: Literal["base", "plate"] = "base"
    """Whose axes the box is in: the arm's base, or the plate (right, up, into the plate)."""
    plate: PlaneSettings | None = None
    """The taught contact plane if left out."""
    speed_mm_s: Positive = 50.0
    depth_mm: Finite | None = None
    """Largest distance of the tool centre point beyond the taught plane; needs `plate`."""
    tilt_deg: Annotated[float, Field(gt=0, le=180)] = 180.0
    """Largest rotation of the tool in a move."""
    singular_deg: Annotated[float, Field(ge=0, le=45)] = 5.0
    """Smallest allowed angle of wrist 2 (UR) or joint 5 (ABB) from the singularity."""

    @rule
    def _makes_sense(self) -> ArmLimits:
        for axis, low, high in zip("xyz", self.low_mm, self.high_mm, strict=True):
            if low >= high:
                text = f"{axis} is not below high_mm = {list(self.high_mm)}"
                raise KeyedError(".low_mm", list(self.low_mm), text)
        return self


class ToolSettings(StrictModel):
    """The tool that is mounted on the flange."""

    tcp_mm: Triple = (0.0, 0.0, 0.0)
    tcp_rotvec_deg: Triple = (0.0, 0.0, 0.0)
    """Tool centre point in the flange's frame."""
    mass_kg: Annotated[float, Field(ge=0, le=50)] = 0.0
    centre_of_mass_mm: Triple = (0.0, 0.0, 0.0)


class BaseArmSettings(DriverSettings):
    """Settings that arms of every make have."""

    host_clock: ClassVar[bool] = False
    """The controller has no clock to read: poses are stamped by this computer's."""
    host: Host
    tool: ToolSettings = ToolSettings()
    limits: ArmLimits


_SHORTEST_MM = 1.0
"""Shortest plausible tool or plate; one given in metres is shorter than this."""
_SMALLEST_MM = 2.0
"""Shortest plausible longest side of the workspace box; in metres every side is shorter."""
_RADIANS = 1e-3


def check_units(arm: BaseArmSettings) -> None:
    """Check that lengths were not written in metres, and rotations not in radians.

    Raises:
        KeyedError: a value is implausible in the unit of its key.
    """
    tool, limits, key = arm.tool, arm.limits, "devices.arm"
    for name, vector in (
        ("tcp_mm", tool.tcp_mm),
        ("centre_of_mass_mm", tool.centre_of_mass_mm),
    ):
        if 0 < math.hypot(*vector) < _SHORTEST_MM:
            raise _in_metres(f"{key}.tool.{name}", vector, "is less than a millimetre long")
    turn = math.hypot(*tool.tcp_rotvec_deg)
    if any(abs(turn - part * math.pi) < _RADIANS for part in (0.5, 1.0)):
        raise KeyedError(
            f"{key}.tool.tcp_rotvec_deg",
            tool.tcp_rotvec_deg,
            f"looks like radians: write degrees, such as {_row(tool.tcp_rotvec_deg, 57.29578)}",
        )
    sides = [high - low for low, high in zip(limits.low_mm, limits.high_mm, strict=True)]
    if max(sides) < _SMALLEST_MM:
        text = f"to high_mm is a box of {' x '.join(f'{side:g}' for side in sides)} mm"
        raise _in_metres(f"{key}.limits.low_mm", limits.low_mm, text)
    if limits.plate is not None:
        for name in ("right_mm", "above_mm"):
            point = getattr(limits.plate, name)
            if math.dist(limits.plate.centre_mm, point) < _SHORTEST_MM:
                text = "is less than a millimetre from centre_mm"
                raise _in_metres(f"{key}.limits.plate.{name}", point, text)


def _in_metres(key: str, vector: Triple, text: str) -> KeyedError:
    return KeyedError(key, vector, f"{text}: write millimetres, such as {_row(vector, 1000)}")


def _row(vector: Triple, factor: float) -> str:
    return f"[{', '.join(f'{value * factor:g}' for value in vector)}]"
