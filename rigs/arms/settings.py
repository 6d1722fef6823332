"""Settings of the real arms as a rig file gives them; cheap to import.

Units stand in the names: a rig file's numbers for one make of arm are the maker's own, and
belong to the rig, not to the protocol.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from sliplab.protocols.yaml_file import KeyedError, StrictModel
from sliplab.rigs.address import BindAddress, Host

Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
Triple = tuple[Finite, Finite, Finite]
Port = Annotated[int, Field(ge=1, le=65535)]


class PlaneSettings(StrictModel):
    """The plate as three touched points in the arm's base frame, for limits that follow it."""

    centre_mm: Triple
    right_mm: Triple
    above_mm: Triple


class Limits(StrictModel):
    """What the arm may do, checked before every move, whatever a protocol says."""

    low_mm: Triple
    high_mm: Triple
    """Corners of the box that the tool centre point may not leave."""
    frame: Literal["base", "plate"] = "base"
    """Whose axes the box is in: the arm's base, or the plate (right, up, into the plate)."""
    plate: PlaneSettings | None = None
    """Left out, the contact plane that the rig was taught."""
    speed_mm_s: Positive = 50.0
    depth_mm: Finite | None = None
    """How far beyond the taught plane the tool centre point may go; needs `plate`."""
    tilt_deg: Annotated[float, Field(gt=0, le=180)] = 180.0
    """How far a move may turn the tool."""
    singular_deg: Annotated[float, Field(ge=0, le=45)] = 5.0
    """How close wrist 2 (UR) or joint 5 (ABB) may be to where two axes fall together."""

    @model_validator(mode="after")
    def _makes_sense(self) -> Limits:
        for axis, low, high in zip("xyz", self.low_mm, self.high_mm, strict=True):
            if low >= high:
                raise KeyedError(
                    "devices.arm.limits.low_mm", list(self.low_mm), f"{axis} is not below high_mm"
                )
        return self


class ToolSettings(StrictModel):
    """What is mounted on the flange."""

    tcp_mm: Triple = (0.0, 0.0, 0.0)
    tcp_rotvec_deg: Triple = (0.0, 0.0, 0.0)
    """Tool centre point in the flange's frame."""
    mass_kg: Annotated[float, Field(ge=0, le=50)] = 0.0
    centre_of_mass_mm: Triple = (0.0, 0.0, 0.0)


class _Arm(StrictModel):
    host: Host
    tool: ToolSettings = ToolSettings()
    limits: Limits


class UrSettings(_Arm):
    """A Universal Robots e-Series arm, PolyScope 5.6 to 5.x, in remote control.

    Its ports are fixed by the client and by the controller: 30004 RTDE, 29999 dashboard, 30003
    scripts. Segments are not blended: the arm comes to rest between two of them, so each is at
    constant speed between its ramps.
    """

    driver: Literal["ur"] = "ur"
    acceleration_mm_s2: Positive = 100.0
    """At the start and the end of each segment."""
    frequency_hz: Annotated[int, Field(ge=10, le=500)] = 500
    """Rate of the pose stream; 500 is the controller's own."""
    sync_input: Annotated[int, Field(ge=0, le=17)] = 0
    """Bit of `actual_digital_input_bits` that the sync line is on (0 to 7: standard inputs)."""


class AbbSettings(_Arm):
    """An ABB arm on an IRC5 controller, by motion programs (option a, the default)."""

    driver: Literal["abb"] = "abb"
    rws_port: Port = 80
    egm_port: Port = 6510
    """UDP port on this host to which the controller sends its poses."""
    egm_bind: BindAddress = "0.0.0.0"
    egm_host: Host | None = None
    """Address that the poses come from, if it is not `host`; packets of any other are dropped."""
    username: str = "Default User"
    password: str = Field(default="robotics", repr=False)
    egm_point: Literal["tool", "flange"] = "tool"
    """Whose pose the controller's EGM stream tells; held against the web services on connecting."""
    task: Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")] = "T_ROB1"
    watchdog_s: Annotated[float, Field(ge=0.3, le=5)] | None = 1.0
    """The controller stops the arm when this host has been silent for so long, by the module
    `sliplab_watchdog.mod` (`docs/arms.md`), without which it does not connect. null: it has no
    such module, and a path runs to its end when this host or the network is gone."""


class AbbSocketSettings(_Arm):
    """An ABB arm behind the small RAPID socket server that some labs run (option b)."""

    driver: Literal["abb_socket"] = "abb_socket"
    port: Port = 5000
    segment_s: Annotated[float, Field(gt=0, le=2)] = 0.25
    """Longest time one request may move for: a stop waits for it to end."""


ArmSettings = UrSettings | AbbSettings | AbbSocketSettings

_SHORTEST_MM = 1.0
"""A tool or a plate in metres is shorter, and no real one in millimetres is."""
_SMALLEST_MM = 2.0
"""Side of a box of limits; of one in metres all are shorter."""
_RADIANS = 1e-3


def check_units(arm: ArmSettings) -> None:
    """Look for lengths that were written in metres and turns that were written in radians.

    Raises:
        KeyedError: a value that no arm can have in the unit of its key.
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
            f"is a turn in radians: write degrees, such as {_row(tool.tcp_rotvec_deg, 57.29578)}",
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
