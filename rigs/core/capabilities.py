"""Capabilities: the interfaces that the devices of a rig implement, as protocols.

A driver, a driver on a fake, and a simulated device are interchangeable if they implement these.
Every call returns within a bounded time or raises a `RigError`; no call waits for a motion to end.
Time passes only in `Clock.wait`, so a simulated rig runs faster than real time with the same code.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import ClassVar, Literal, NotRequired, Protocol, TypedDict, runtime_checkable

from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.program import PlateAction
from sliplab.protocols.timing import Code, ForceGrade
from sliplab.rigs.core.gripper_range import GripperRange
from sliplab.storage.streams import (
    Chunk,
    ClockReads,
    EventChunk,
    FrameChunk,
    PoseChunk,
    PulseChunk,
    Sink,
    WrenchChunk,
)

UNKNOWN = "unknown"
"""Value in `DeviceHealth` of a property that a device does not report."""


class RigError(RuntimeError):
    """A failed action of the rig. `device` names the part; the text says what to do."""

    def __init__(self, device: str, message: str) -> None:
        super().__init__(f"{device}: {message}")
        self.device = device


class ArmFault(RigError):
    """The arm cannot move: protective or emergency stop, or no connection."""


class StaysInContact(RigError):
    """A failure after which the arm is stopped, and must not be moved clear."""

    plate_held: ClassVar[bool] = False
    """Whether fingers hold a plate that was released."""


class PoseFault(ArmFault, StaysInContact):
    """The arm's poses are not what it does: a way out that began at one could lead sideways."""


class ArmState(Enum):
    """State that an arm reports."""

    READY = "ready"
    MOVING = "moving"
    PROTECTIVE_STOP = "protective stop"
    EMERGENCY_STOP = "emergency stop"
    DISCONNECTED = "disconnected"
    REMOTE_CONTROL_OFF = "remote control off"
    NOT_RUNNING = "not running"
    """Switched off, or the program that listens for moves has ended."""

    @property
    def healthy(self) -> bool:
        """True if the arm may be asked to move."""
        return self in {ArmState.READY, ArmState.MOVING}

    @property
    def advice(self) -> str:
        """The action that the operator must take; SlipLab never unlocks or restarts an arm."""
        return {
            ArmState.PROTECTIVE_STOP: "clear the cause and unlock the stop at the pendant",
            ArmState.EMERGENCY_STOP: (
                "release the emergency stop and restart the arm at the pendant"
            ),
            ArmState.DISCONNECTED: "check power and network of the arm's controller",
            ArmState.REMOTE_CONTROL_OFF: "switch the pendant to remote control",
            ArmState.NOT_RUNNING: "switch the arm on at the pendant, then connect again",
        }.get(self, "check the arm")


@dataclass(frozen=True)
class Pose:
    """Tool centre point in the arm's base frame: mm, and a rotation vector in degrees."""

    xyz_mm: tuple[float, float, float]
    rotvec_deg: tuple[float, float, float]


@dataclass(frozen=True)
class Segment:
    """One straight move of the tool centre point at constant speed, or a turn on the spot.

    Attributes:
        turn_deg_s: speed of a turn on the spot; None for a move. `speed_mm_s` then bounds the
            tool centre point, which should not move.
    """

    to: Pose
    speed_mm_s: float
    turn_deg_s: float | None = None


@dataclass(frozen=True)
class Progress:
    """Progress of a started path: (start, end) controller times of finished segments, ns."""

    state: ArmState
    finished: tuple[tuple[int, int], ...]
    done: bool


@dataclass(frozen=True)
class DeviceHealth:
    """A device's status report, read without starting it; `unknown` where it reports nothing."""

    device: str
    """Its part in the rig, as `RigError` names it."""
    model: str
    serial: str
    firmware: str
    temperature_c: float | None
    """Degrees Celsius; None where the device has no readable temperature sensor."""
    clock: str
    """Clock of its time stamps."""
    notes: tuple[str, ...] = ()
    """Further details for people: region, buffers, speed of the link."""


@runtime_checkable
class Clock(Protocol):
    """The host's monotonic clock; the simulated one is virtual."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary origin."""

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass."""


@runtime_checkable
class Arm(Protocol):
    """A six-axis arm with a controller clock, and perhaps a digital input on the sync line."""

    def connect(self) -> None:
        """Open the connection; bounded. Raises ArmFault."""

    def state(self) -> ArmState:
        """The arm's state now."""

    def pose(self) -> Pose:
        """Return where the tool centre point is now."""

    def now_ns(self) -> int:
        """The controller's clock now."""

    def start(self, path: Sequence[Segment]) -> None:
        """Start to follow `path` and return at once. Raises ArmFault, or RigError if moving."""

    def progress(self) -> Progress:
        """Return the progress of the path started last."""

    def read_poses(self) -> PoseChunk:
        """Poses since the last call."""

    def read_pulses(self) -> PulseChunk:
        """Sync pulses seen by the digital input since the last call, controller clock.

        Empty where the input is not wired.
        """

    def stop(self) -> None:
        """Stop now; safe to call at any time and more than once; never unlocks anything."""

    def close(self) -> None:
        """Close the connection."""


@runtime_checkable
class StoppingArm(Protocol):
    """An arm with a stopping distance; any other is taken to stop at once."""

    def stopping_s(self, speed_mm_s: float) -> float:
        """Stopping distance as time at full speed: reaction, and half of braking."""


@runtime_checkable
class EventCamera(Protocol):
    """An event camera with an input for sync pulses."""

    width: int
    height: int

    def start(self) -> None:
        """Start streaming; earlier data are discarded."""

    def read(self) -> EventChunk:
        """Events since the last call."""

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call, camera clock in ns."""

    def stop(self) -> None:
        """Stop streaming."""

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class FrameCamera(Protocol):
    """The camera that looks through the plate."""

    px_per_mm: float
    mid_exposure_ns: int
    """Time from the start of an exposure to its middle, which is the time of a frame."""

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out only a centred region."""

    def start(self) -> None:
        """Start grabbing, on the sync box's ticks or free-running; frames count from 0 again."""

    def read(self) -> FrameChunk:
        """Frames since the last call."""

    def read_clock(self) -> ClockReads:
        """Read the camera's clock once: one row. Called only on cameras with a readable clock."""

    def stop(self) -> None:
        """Stop grabbing."""

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class SyncBox(Protocol):
    """A box that triggers a frame on each tick, and sends a pulse on ticks with a code bit 1."""

    def connect(self) -> None:
        """Check that a box answers; reconnects after a fault. Raises RigError."""

    def start(self, rate_hz: float, seed: int, code: Code) -> None:
        """Start ticks and a code of `rigs.core.pulse_code` from `seed`, a 32-bit number."""

    def read_pulses(self) -> PulseChunk:
        """Pulses sent since the last call; the box's clock starts at 0 with `start`."""

    def read_exposures(self) -> PulseChunk:
        """Starts of the frame camera's exposures since the last call, box clock.

        Exposures are recorded from `start` to `close`, also those whose frame is lost later; none
        if the camera's output is not wired.
        """

    def read_clock(self) -> ClockReads:
        """Read the box's clock once: one row."""

    def stop(self) -> None:
        """Stop the ticks; the clock keeps running."""

    def close(self) -> None:
        """Release the device."""


@dataclass(frozen=True)
class Mounting:
    """Orientation of a force sensor's axes, and the sign of its load, relative to the plate."""

    axes: Literal["plate", "base"] = "plate"
    """The frame that `rotvec_deg` turns to: the plate's axes (x right, y up, z into the plate),
    with which the tool is aligned, or those of the arm's base."""
    rotvec_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector from the sensor's axes to that frame."""
    feels: Literal["plate", "arm"] = "plate"
    """The body whose load it reports: the plate, or the arm, which feels the plate's reaction."""


@runtime_checkable
class ForceSensor(Protocol):
    """A sensor of force and torque with its own clock, or that of the arm."""

    mounting: Mounting
    grade: ForceGrade
    """Method by which its samples are placed on the time line."""
    zeroing: Literal["trial", "session", "never"]
    """When the rig, or the sensor itself, takes the present load for zero: before each trial while
    the arm is clear of the plate, once when it connects, or never."""

    def connect(self) -> None:
        """Open the connection; bounded. Raises RigError."""

    def start(self) -> None:
        """Start streaming; earlier data are discarded."""

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call, sensor's axes and clock.

        Raises:
            RigError: it fell silent, restarted, or says that its readings are not to be trusted.
        """

    def zero(self) -> None:
        """Zero (tare) the sensor at the present load."""

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""

    def close(self) -> None:
        """Release the device."""


@runtime_checkable
class Sensor(Protocol):
    """A sensor with a stream, which the host times by arrival."""

    def connect(self) -> None:
        """Open the connection; bounded. Raises RigError."""

    def start(self) -> None:
        """Start streaming; earlier readings are discarded."""

    def read(self) -> Chunk:
        """Readings since the last call, their times the host's clock at reception.

        Raises:
            RigError: it fell silent.
        """

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""

    def close(self) -> None:
        """Close the connection."""


@runtime_checkable
class ScalarSensor(Sensor, Protocol):
    """A sensor of one quantity, such as a temperature; it returns `ScalarChunk`."""

    unit: str
    """Unit of its readings."""


@dataclass(frozen=True)
class GripperState:
    """State of a gripper.

    Attributes:
        moving: fingers have not finished the last move.
        stalled: they ended it at an object, or at the force limit.
    """

    opening_mm: float
    moving: bool
    stalled: bool


@runtime_checkable
class Gripper(Protocol):
    """A gripper with parallel fingers, which press the sensor on the object as they close."""

    range: GripperRange

    def connect(self) -> None:
        """Open the connection, and check that the gripper is active; bounded. Raises RigError."""

    def state(self) -> GripperState:
        """Return opening and motion. Raises RigError where it reports a fault, or no answer."""

    def move(self, opening_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start to move the fingers to an opening and return at once.

        An opening between two steps is rounded to the wider one: never is more closed than asked.

        Args:
            force_n: at which closing fingers stall.

        Raises:
            RigError: a value is out of range, and nothing is sent; or no connection.
        """

    def stop(self) -> None:
        """Stop the fingers where they are; safe to call at any time and more than once."""

    def close(self) -> None:
        """Close the connection; the fingers stay, and keep their grip."""


@runtime_checkable
class Plate(Protocol):
    """The plate on its vertical slider (gravity and disturbance trials)."""

    def act(self, action: PlateAction, seconds: float) -> None:
        """Raise and hold the plate, release it over `seconds`, or catch it; returns at once."""

    def mass_kg(self) -> float:
        """Mass mounted now, as the rig knows it (from a scale, or confirmed by the operator)."""


@runtime_checkable
class Operator(Protocol):
    """The person at the rig."""

    def ask(self, task: str, prompt: str, expected: str) -> bool:
        """Ask for something to be done; True once confirmed.

        Args:
            task: changeover (another plate), condition (another skin, ...), clean, jog, ...
        """


class TrueOnsets(TypedDict):
    """True onsets of a simulated trial, counted from a reference time; ns of the sync box.

    Attributes:
        incipient_ns: the first of `per_papilla_ns`; gross_ns: the centre's.
        per_papilla_ns: when each marker's displacement relative to the plate exceeded the
            threshold; None where it did not.
        first_slip_ns: the first of `slip_per_papilla_ns`.
        slip_per_papilla_ns: when each tip physically began to slide; None where it did not.
    """

    reference_ns: int
    incipient_ns: int | None
    gross_ns: int | None
    per_papilla_ns: list[int | None]
    first_slip_ns: int | None
    slip_per_papilla_ns: list[int | None]


class TrueOnsetsFromHold(TrueOnsets):
    """True onsets counted from the start of the recorded hold.

    Attributes:
        hold_slip_mm: movement of each marker in the hold.
    """

    hold_slip_mm: list[float]


class Truth(TrueOnsets):
    """Truth of a simulated trial, which labels are checked against.

    Attributes:
        simulated: true.
        level: of physics.
        threshold_mm: displacement of a marker that counts as slip.
        from_hold: the same from the start of the hold, if requested.
        clocks: pairs of a device's clock and the sync box's, ns, by device; absent from
            a simulation server.
    """

    simulated: bool
    level: str
    threshold_mm: float
    from_hold: NotRequired[TrueOnsetsFromHold]
    clocks: NotRequired[dict[str, list[list[int]]]]


class PlateCourse(TypedDict):
    """A simulated plate through a motion; rows at rising times, ms from a reference.

    Attributes:
        height_mm: of the plate, 0 where it is raised. stroke_mm: that it falls to its stop.
        normal_n: sum of the contact's normal forces.
        depth_mm: of the sensor: the arm's, and what fingers add.
    """

    t_ms: list[float]
    height_mm: list[float]
    normal_n: list[float]
    depth_mm: list[float]
    stroke_mm: float


@runtime_checkable
class Simulation(Protocol):
    """The world behind a simulated rig; a real rig has none."""

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Reset the world, and draw everything that varies by trial from `seed`.

        Args:
            nuisances: what disturbs the trial, besides the arm's motions.
        """

    def sink(self, sink: Sink) -> Sink:
        """Wrap `sink` in this world's storage faults, such as a full disk."""

    def truth(self, reference_arm_ns: int, hold_arm_ns: int | None = None) -> Truth:
        """Return the ground truth of the trial that just ran, times in ns of the sync box.

        Args:
            reference_arm_ns: arm controller time from which displacements are measured.
            hold_arm_ns: start of the recorded hold, to measure displacements from there too.
        """

    def watch_plate(self) -> None:
        """Keep the forces on the plate from now on, for `plate_course`, until the trial ends."""

    def plate_course(self, since_arm_ns: int) -> PlateCourse:
        """Return what was recorded since an arm controller time, after `watch_plate`."""
