"""Driver declarations: everything that SlipLab knows about a type of device.

Each device's folder has one declaration: its settings in a rig file, how it is built and pinged,
which resources need a lock, and its fake on a loopback rig. Nothing outside the folder refers to
the device by name (`rigs.core.registry` finds it). Declarations are cheap to import: a vendor
library is loaded when a device is built, not when a rig file is read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeAlias, TypeVar

from sliplab.rigs.core.arm_settings import BaseArmSettings
from sliplab.rigs.core.device_settings import DriverSettings, GripperSettings
from sliplab.rigs.core.sections import RigSection, SimulatedStream

if TYPE_CHECKING:
    from sliplab.protocols.key_errors import KeyedError
    from sliplab.protocols.timing import Code, FrameGrade, StreamGrade
    from sliplab.rigs.core.capabilities import (
        Arm,
        Clock,
        EventCamera,
        ForceSensor,
        FrameCamera,
        Gripper,
        Sensor,
        SyncBox,
    )
    from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion
    from sliplab.rigs.core.fakes import FakeController
    from sliplab.rigs.core.finger_motion import FingerMotion
    from sliplab.rigs.core.gripper_range import GripperRange
    from sliplab.rigs.core.rig import Rig
    from sliplab.storage.streams import EventChunk, FrameChunk, PulseChunk, StreamKind, WrenchChunk

SettingsT = TypeVar("SettingsT", bound=DriverSettings)
ArmSettingsT = TypeVar("ArmSettingsT", bound=BaseArmSettings)
GripperSettingsT = TypeVar("GripperSettingsT", bound=GripperSettings)
BuildRig: TypeAlias = "Callable[[Any, Callable[[], bool]], Rig]"
"""Builds the rig of a `rigs.rig_file.RigFile`; the other argument says whether to stop."""


def _no_locks(settings: Any) -> dict[str, str]:
    return {}


def _no_address(settings: Any) -> str:
    return ""


def lazy(place: str) -> Callable[..., Any]:
    """Return a function that imports ``module:object`` when it is called, and calls that."""
    module, _, name = place.partition(":")

    def call(*arguments: Any, **named: Any) -> Any:
        return getattr(import_module(module), name)(*arguments, **named)

    return call


@dataclass(frozen=True)
class Declaration:
    """The declaration of what a rig file names by `driver:`."""

    kind: ClassVar[str]
    """``arm``, ``event camera``, ``frame camera``, ``sync box``, ``force sensor``, ``gripper``,
    ``scalar sensor`` or ``rig``."""
    name: str
    title: str
    """Make and model for people, such as ``Universal Robots``."""


@dataclass(frozen=True)
class RigDriver(Declaration):
    """A way to run a rig: real devices, simulated ones, or real drivers on fakes."""

    kind = "rig"
    sections: tuple[str, ...] = field(kw_only=True)
    """Sections that its rig files have: `devices`, `mock`; the first one has what is driven."""
    settings: type[RigSection] = field(kw_only=True)
    """Model of its first section."""
    build: BuildRig = field(kw_only=True)
    """Build the rig of a `rigs.rig_file.RigFile`, its arm not connected yet; the other argument
    returns whether a stop was requested. Raises RigError."""
    faults: Callable[[Any], Iterable[KeyedError]] = lambda rig: ()
    """Return what else is wrong with such a file."""
    builder: Callable[[Any], AbstractContextManager[BuildRig]] | None = None
    """Return what builds the rigs of one trial after the other for such a file, where they share
    what takes long to start; it ends with the block."""
    streams: Mapping[str, type[SimulatedStream]] = field(default_factory=dict)
    """Models of simulated further devices, by the kinds of their streams."""
    levels: Callable[[], Any] | None = None
    """Return its `rigs.physics_levels.PhysicsLevels`; None: it simulates no scene."""


@dataclass(frozen=True)
class Driver(Declaration, Generic[SettingsT]):
    """The declaration of one type of device. `name` is the value of `driver:` in rig files."""

    settings: type[SettingsT]
    """Keys that a rig file may write; field `driver` is a `Literal` of `name`."""
    ping: Callable[[SettingsT], str | None]
    """Check within seconds that the device can be reached, without taking control of it.

    Returns None if it can, else the reason and what to check. May raise RigError.
    """
    libraries: tuple[str, ...] = ()
    """Modules of the vendor library, which are checked before a device is built."""
    address: Callable[[SettingsT], str] = _no_address
    """Address for people, such as a host name; empty where there is none to show."""
    locks: Callable[[SettingsT], dict[str, str]] = field(default=_no_locks)
    """Resources for one program at a time: lock name (``arm-192.168.0.9``) and description."""


@dataclass(frozen=True)
class ArmScene:
    """The part of a simulated scene that the fake of an arm needs on a loopback rig."""

    motion: StraightMotion
    """Motion of the tool centre point."""
    clock: ControllerClock
    sync: Callable[[float], bool]
    """Level of the sync line at a time of the controller's clock, s."""
    reach_mm: float
    """Reach of the fake from its base; the driver enforces the rig file's limits."""
    load: Callable[[float], Sequence[float] | None] | None = None
    """Force (N) and torque (N m) on the tool in the axes of the base at a time of the controller's
    clock, s, where the arm measures them (`ForceSensorDriver.of_arm`); returns None while the
    scene has not come to that time."""


@dataclass(frozen=True)
class ArmDriver(Driver[ArmSettingsT]):
    """A kind of arm."""

    kind = "arm"
    build: Callable[[ArmSettingsT], Arm] = field(kw_only=True)
    """Make the device, not connected yet."""
    build_measuring: Callable[[ArmSettingsT], Arm] | None = None
    """The same, of an arm that also sends its wrench, for a `ForceSensorDriver.of_arm`."""
    twists: bool = True
    """It can turn the tool on the spot at a speed (`Segment.turn_deg_s`)."""
    fake: Callable[[ArmSettingsT, ArmScene], FakeController] | None = None
    """Build a fake controller, not started yet; None: not available on a loopback rig."""

    def builder(self, measures: bool) -> Callable[[ArmSettingsT], Arm]:
        """Return what makes the device; with `measures`, one that sends its wrench if it can."""
        return (measures and self.build_measuring) or self.build


class Fake(Protocol):
    """A fake of a device, which a driver reaches by its address."""

    @property
    def address(self) -> Any:
        """Address for the driver, used by its `reach`; it can be pickled."""

    def close(self) -> None:
        """Break the connections, as an unplugged cable would; safe to call more than once."""


class FakeEventCamera(Fake, Protocol):
    """A fake event camera that sends the events of a simulated scene."""

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events and rising edges of the input; nothing while stalled."""

    def stall(self) -> None:
        """Stop sending; the connection stays open."""


@dataclass(frozen=True)
class EventCameraDriver(Driver[SettingsT]):
    """A kind of event camera."""

    kind = "event camera"
    build: Callable[[SettingsT], EventCamera] = field(kw_only=True)
    """Open the device, not streaming yet. Raises RigError."""
    fake: Callable[[tuple[int, int]], FakeEventCamera] | None = None
    """Build a fake with the given numbers of columns and rows."""
    reach: Callable[[SettingsT, Any], SettingsT] | None = None
    """Return settings that reach a fake at an address."""


class SceneFrames(Protocol):
    """The frames of a simulated scene in another process."""

    def grab(self, width_px: int, height_px: int, on_frames: Callable[[FrameChunk], None]) -> None:
        """Start to expose a centred region.

        Args:
            on_frames: called in a thread with every chunk of frames, until the next grab.
        """

    def stop_grabbing(self) -> None:
        """Stop; an empty chunk ends the frames."""


@dataclass(frozen=True)
class FrameCameraDriver(Driver[SettingsT]):
    """A kind of frame camera."""

    kind = "frame camera"
    build: Callable[[SettingsT, float], FrameCamera] = field(kw_only=True)
    """Open the device, not grabbing yet, with its scale in px per mm. Raises RigError."""
    fake: Callable[[SettingsT, float, SceneFrames, int], FrameCamera] | None = None
    """Open the driver on frames of a scene: settings, px per mm, frames, half the exposure (ns)."""
    unplug: Callable[[Any], None] | None = None
    """Unplug a camera that `fake` has opened, for tests."""
    grade: FrameGrade = "hardware trigger"
    """Timing of frames on a loopback rig: `host arrival` where the camera is free-running."""


@dataclass(frozen=True)
class PulseTrain:
    """A train of pulses that a fake box started, for the rest of a simulated scene."""

    first_ns: int
    """Tick 0 on the clock that drives the box, ns."""
    rate_hz: float
    seed: int
    code: Code


class FakeBox(Fake, Protocol):
    """A fake sync box, which sends its pulses by itself."""

    pulses: int
    """Number of pulses of the running or last train."""

    def reset(self) -> None:
        """Restart as after a brown-out: no train, and a restarted clock."""

    def silence(self) -> None:
        """Hang: send and answer nothing from now on."""

    def answer_late(self) -> None:
        """Hold the answer to the next request back until the one after it."""


OnTrain = Callable[[PulseTrain | None, int], None]
"""Called with every train before its first tick, and at its end with None and the ticks sent."""


@dataclass(frozen=True)
class SyncBoxDriver(Driver[SettingsT]):
    """A kind of sync box."""

    kind = "sync box"
    build: Callable[[SettingsT], SyncBox] = field(kw_only=True)
    """Make the device, not connected yet."""
    fake: Callable[[Callable[[], int], OnTrain], FakeBox] | None = None
    """Build a fake from the clock that drives it, ns, and a receiver of its trains."""
    reach: Callable[[SettingsT | None, Any], SettingsT] | None = None
    """Return settings that reach a fake at an address; the rest from a rig file's settings where
    it has some."""


class FakeForceSensor(Fake, Protocol):
    """A force sensor on a wire, that sends what a simulated scene shows."""

    def send(self, chunk: WrenchChunk) -> None:
        """Send samples of the plate's load, in the sensor's axes and clock."""

    def overload(self) -> None:
        """The load is out of range from now on."""

    def silence(self) -> None:
        """Send nothing from now on."""


@dataclass(frozen=True)
class ForceSensorDriver(Driver[SettingsT]):
    """A kind of force sensor."""

    kind = "force sensor"
    build: Callable[[SettingsT, Arm], ForceSensor] = field(kw_only=True)
    """Make the device, not connected yet; the arm is given as its controller may measure forces.

    Raises RigError where that arm has none.
    """
    of_arm: bool = False
    """The arm's controller measures and sends it, so the arm's fake does, by `ArmScene.load`."""
    fake: Callable[[SettingsT], FakeForceSensor] | None = None
    """Make a fake; None: no loopback rig can have this sensor, unless it is the arm's."""
    reach: Callable[[SettingsT, Any], SettingsT] | None = None
    """Return settings that reach a fake at an address."""


@dataclass(frozen=True)
class GripperScene:
    """The part of a simulated scene that the fake of a gripper needs."""

    fingers: FingerMotion
    """Motion of the fingers, which stall at the contact in the scene."""
    now_ns: Callable[[], int]
    """Time by which the fingers move, ns."""


class FakeGripper(Fake, Protocol):
    """A gripper on a wire, whose fingers are a simulated scene's."""

    def silence(self) -> None:
        """Hang: answer nothing from now on."""

    def fail(self) -> None:
        """Report a fault from now on, and stop."""


@dataclass(frozen=True)
class GripperDriver(Driver[GripperSettingsT]):
    """A kind of gripper."""

    kind = "gripper"
    build: Callable[[GripperSettingsT], Gripper] = field(kw_only=True)
    """Make the device, not connected yet."""
    range: Callable[[GripperSettingsT], GripperRange] = field(kw_only=True)
    """Return the values that commands may have, without the device."""
    fake: Callable[[GripperSettingsT, GripperScene], FakeGripper] | None = None
    """Make a fake; None: no loopback rig can have this gripper."""
    reach: Callable[[GripperSettingsT, Any], GripperSettingsT] | None = None
    """Return settings that reach a fake at an address."""


class FakeSensor(Fake, Protocol):
    """A fake sensor that sends rows of numbers."""

    clocked: bool
    """Its rows have the times of a clock of its own, which must not fall back."""

    def send(self, rows: Mapping[str, Any]) -> None:
        """Send rows: arrays (n,) of times `t`, ns, and of each column by its stored name."""

    def silence(self) -> None:
        """Send nothing from now on."""


@dataclass(frozen=True)
class SensorDriver(Driver[SettingsT]):
    """A kind of sensor of one quantity, or of another kind of stream."""

    kind = "scalar sensor"
    build: Callable[[SettingsT], Sensor] = field(kw_only=True)
    """Make the device, not connected yet; a `ScalarSensor` where `stream` is not set."""
    stream: StreamKind | None = None
    """The kind of its stream; None for readings of one quantity."""
    grade: Callable[[SettingsT], StreamGrade] | None = None
    """Return the only grade of its times; None: as the rig file says."""
    simulate: Callable[[SettingsT, Clock], Sensor] | None = None
    """Make a simulated device, timed by a simulated rig's clock; None: no such rig can have it."""
    fake: Callable[[SettingsT], FakeSensor] | None = None
    """Make a fake, for tests of the driver."""
    reach: Callable[[SettingsT, Any], SettingsT] | None = None
    """Return settings that reach a fake at an address."""

    @property
    def sends(self) -> str:
        """The kind's name, which a rig file writes as `kind`."""
        return "scalar" if self.stream is None else self.stream.name


ScalarSensorDriver = SensorDriver
"""The former name, which packages use."""
