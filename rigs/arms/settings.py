"""Settings of the real arms as a rig file gives them; cheap to import.

Units stand in the names: a rig file's numbers for one make of arm are the maker's own, and
belong to the rig, not to the protocol.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from protocols.yaml_file import KeyedError, StrictModel

Finite = Annotated[float, Field(ge=-1e6, le=1e6)]
Positive = Annotated[float, Field(gt=0, le=1e6)]
Triple = tuple[Finite, Finite, Finite]
Port = Annotated[int, Field(ge=1, le=65535)]
Host = Annotated[str, Field(min_length=1, max_length=253, pattern=r"^[A-Za-z0-9.\-]+$")]


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
    egm_bind: Host = "0.0.0.0"
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
