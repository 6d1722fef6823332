"""Timing of a rig's devices: which signal reaches which, and how good their clocks are.

A rig file states it, every trial's record keeps it, and synchronising stored data reads it there.
A grade is a name for how a device's time is known; every grade has its own uncertainty and its own
gate (docs/clocks.md), and a latency is never shown without it.
"""

from __future__ import annotations

from decimal import Decimal
from typing import Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.quantity import PositiveSeconds
from sliplab.protocols.yaml_file import StrictModel, rule

Code = Literal["lfsr", "irregular", "regular"]
"""Pulses of the box: 32-bit LFSR, irregular intervals, or a regular train with a start marker."""
FrameGrade = Literal["hardware trigger", "exposure line", "device time stamps", "host arrival"]
ArmGrade = Literal["digital input", "host time"]
ForceGrade = Literal["host time", "arm clock"]
WIRED: tuple[str, ...] = ("hardware trigger", "exposure line", "digital input", "trigger input")
"""Grades by which a device's time is known from a wire; the others go through the host."""

MARKER_TICKS = 16
"""A regular train begins with a pulse and this many ticks without one; then every second tick."""
CRYSTAL_PPM = 200.0


class DeviceClock(StrictModel):
    """One device's clock."""

    drift_ppm: float = Field(default=CRYSTAL_PPM, gt=0, le=20_000)
    """The most that it may differ from true time: 200 for a crystal, 5000 for a ceramic
    resonator."""
    jitter_us: float = Field(default=20.0, gt=0, le=5_000)
    """Scatter of its stamps to be expected, one standard deviation."""
    resolution_us: float = Field(default=1.0, ge=0, le=20_000)
    """The unit to which its stamps are cut."""
    rounding: Literal["down", "up", "nearest"] = "down"
    """Direction of rounding; a polled input stamps `up`."""


class Delay(StrictModel):
    """Delay of a message from its device to the host."""

    shortest_us: float = Field(ge=0, le=10_000_000)
    longest_us: float = Field(gt=0, le=10_000_000)

    @rule
    def _ordered(self) -> Delay:
        if not self.shortest_us < self.longest_us:
            raise KeyedError(".longest_us", self.longest_us, "must be above shortest_us")
        return self


class ForceTiming(DeviceClock):
    """The clock of a force sensor."""

    grade: ForceGrade = "host time"
    """`host time`: a sample was taken between two delays before it arrived. `arm clock`: the arm's
    controller stamps it with its own clock, as a Universal Robots arm does with its wrench."""
    delay: Delay = Delay(shortest_us=0, longest_us=5_000)
    """From the load to the host that has the sample, the delay of the sensor's own filter in it;
    where the grade is `host time`."""


StreamGrade = Literal[
    "trigger input",
    "hardware trigger",
    "device time stamps",
    "host arrival",
    "host time",
    "arm clock",
]


class StreamTiming(DeviceClock):
    """The clock of a further device, whose stream has a name."""

    grade: StreamGrade = "host arrival"
    """As that of the first cameras: `trigger input` of an event camera, `hardware trigger`,
    `device time stamps` or `host arrival` of a frame camera, `host arrival` of a scalar sensor,
    `host time` or `arm clock` of a force sensor."""
    delay: Delay = Delay(shortest_us=0, longest_us=50_000)
    """From the end of an exposure, or from the reading, to the host; where the grade is
    `host arrival` or `host time`."""

    @property
    def through_host(self) -> bool:
        """True if the device has no wire, so that the host has to read clocks."""
        return self.grade not in {*WIRED, "arm clock"}


class Timing(StrictModel):
    """The `timing:` section of a rig file."""

    code: Code = "lfsr"
    frames: FrameGrade = "hardware trigger"
    """`hardware trigger`: the box triggers every exposure. `exposure line`: the camera runs by
    itself and the box stamps its ExposureActive output. `device time stamps`: the host reads the
    camera's clock now and then. `host arrival`: the camera has no clock to be read."""
    arm: ArmGrade = "digital input"
    """`digital input`: the controller sees the pulses. `host time`: only when poses arrived."""
    sync_box: DeviceClock = DeviceClock()
    event_camera: DeviceClock = DeviceClock()
    frame_camera: DeviceClock = DeviceClock()
    arm_controller: DeviceClock = DeviceClock()
    pose_delay: Delay = Delay(shortest_us=0, longest_us=20_000)
    """Of the arm's poses, where `arm` is `host time`."""
    frame_delay: Delay = Delay(shortest_us=0, longest_us=50_000)
    """From the end of a frame's exposure to the host, where `frames` is `host arrival`."""

    force: ForceTiming | None = None
    """Of a force sensor; left out, the rig has none, or it is `host time` with its defaults."""

    def start_marker_ns(self, rate_hz: float) -> float | None:
        """From a regular train's first pulse to its second, ns; None if there is a code."""
        return MARKER_TICKS * 1e9 / rate_hz if self.code == "regular" else None

    @property
    def reads_clocks(self) -> bool:
        """True if the host has to read clocks, because some device has no wire."""
        grades = {self.frames, self.arm, self.force.grade if self.force else "arm clock"}
        return not grades <= {*WIRED, "arm clock"}


class SyncGates(StrictModel):
    """The largest 95 % uncertainty of events against another device, by its grade."""

    hardware_trigger: PositiveSeconds = Decimal("0.001")
    exposure_line: PositiveSeconds = Decimal("0.001")
    device_time_stamps: PositiveSeconds = Decimal("0.005")
    host_arrival: PositiveSeconds = Decimal("0.03")
    digital_input: PositiveSeconds = Decimal("0.003")
    host_time: PositiveSeconds = Decimal("0.015")

    def limit_s(self, grade: str) -> float:
        """The gate of a grade, s."""
        return float(getattr(self, grade.replace(" ", "_")))
