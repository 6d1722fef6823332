"""Assembly of a simulated rig, as a rig file with `driver: mock` describes it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

from sliplab.plugins.simulation.arm import MockArm
from sliplab.plugins.simulation.event_camera import MockEventCamera
from sliplab.plugins.simulation.force import MockForceSensor
from sliplab.plugins.simulation.frame_camera import MockFrameCamera
from sliplab.plugins.simulation.further_settings import (
    FurtherEventCamera,
    FurtherFrameCamera,
    Thermometer,
)
from sliplab.plugins.simulation.gripper import MockGripper
from sliplab.plugins.simulation.identity import Identity
from sliplab.plugins.simulation.operator import MockPlate, SimulatedOperator, VirtualClock
from sliplab.plugins.simulation.settings import (
    MockEventCameraSettings,
    MockForceSensorSettings,
    MockFrameCameraSettings,
    MockSettings,
)
from sliplab.plugins.simulation.sync import ExposureLine, FreeRun, MockSyncBox
from sliplab.plugins.simulation.thermometer import MockThermometer
from sliplab.plugins.simulation.truth import clocks_of, readings_of, truth_of
from sliplab.plugins.simulation.world import SimulatedWorld
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.protocols.timing import FrameGrade, Timing
from sliplab.rigs.core.capabilities import ArmFault, RigError, Sensor, Truth
from sliplab.rigs.core.driver import SensorDriver
from sliplab.rigs.core.faults import DeviceGone, DiskFull, StreamGone
from sliplab.rigs.stream_settings import ScalarStream, Stream
from sliplab.storage.clockmap import IDENTITY
from sliplab.storage.streams import Sink

T = TypeVar("T")
FurtherDevice = MockEventCamera | MockFrameCamera | MockForceSensor | MockThermometer | Sensor
GONE = (
    "does not answer (simulated fault); check its power and its cable, "
    "then run the same command to resume"
)


class Guarded:
    """A proxy that calls a check before each call of another object."""

    def __init__(self, target: Any, check: Callable[[], None]) -> None:
        self._target, self._check = target, check

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._target, name)
        if not callable(found):
            return found

        def call(*arguments: Any, **named: Any) -> Any:
            self._check()
            return found(*arguments, **named)

        return call


Cut = type[DeviceGone] | type[StreamGone]


def on_cable(device: T, name: str, world: SimulatedWorld, kind: Cut = DeviceGone) -> T:
    """Wrap `device` so that calls fail while a fault disconnects it; unchanged without faults.

    Args:
        name: of the device; for `StreamGone` of a further device's stream.
    """
    if not any(isinstance(f, kind) and f.target == name for f in world.settings.faults):
        return device
    words = "further device" if kind is StreamGone else name.replace("_", " ")
    error = ArmFault if words == "arm" else RigError

    def check() -> None:
        if world.faults.active(kind, world.now_ns, name):
            raise error(words, GONE)

    return cast(T, Guarded(device, check))


def on_disk(sink: Sink, world: SimulatedWorld) -> Sink:
    """Wrap `sink` so that writes fail once a fault fills the disk; unchanged without faults."""
    if not world.faults.of(DiskFull):
        return sink

    def check() -> None:
        if world.faults.active(DiskFull, world.now_ns):
            raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} (simulated fault)")

    return cast(Sink, Guarded(sink, check))


@dataclass(frozen=True)
class MockDevices:
    """The devices of one simulated rig, which share one world and its virtual clock."""

    clock: VirtualClock
    arm: MockArm
    events: MockEventCamera
    frames: MockFrameCamera
    sync: MockSyncBox
    plate: MockPlate
    operator: SimulatedOperator
    world: SimulatedWorld
    timing: Timing
    force: MockForceSensor | None = None
    gripper: MockGripper | None = None
    further: Mapping[str, FurtherDevice] = field(default_factory=dict)
    """Further devices by the names of their streams."""

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Make the trial depend only on these and the program; see `SimulatedWorld.begin_trial`."""
        self.world.begin_trial(seed, nuisances)

    def sink(self, sink: Sink) -> Sink:
        """Wrap `sink` in this world's storage faults, such as a full disk."""
        return on_disk(sink, self.world)

    def truth(
        self, reference_true_ns: int, hold_true_ns: int | None = None, threshold_px: float = 2.0
    ) -> Truth:
        """Return the ground truth since `reference_true_ns`, and the true clock readings.

        See `truth_of` and `clocks_of` in `truth`.
        """
        stopped_ns = self.sync.stopped_ns
        recorded_ns = (
            self.sync.started_ns,
            (self.world.now_ns if stopped_ns is None else stopped_ns),
        )
        clocks = clocks_of(self.world, self.sync.clock, recorded_ns, self.timing.frames)
        if self.force is not None:
            clocks["force"] = readings_of(self.force.clock, self.sync.clock, recorded_ns)
        for name, device in self.further.items():
            own: Any = device
            clock = IDENTITY if getattr(own, "timed_by_host", True) else own.clock
            clocks[name] = readings_of(clock, self.sync.clock, recorded_ns)
        return {
            **truth_of(self.world, self.sync.clock, reference_true_ns, threshold_px, hold_true_ns),
            "clocks": clocks,
        }


def build_mock(
    settings: MockSettings,
    timing: Timing | None = None,
    further: Mapping[str, Stream] | None = None,
) -> MockDevices:
    """Build the devices of a simulated rig. The same settings give the same rig.

    Args:
        timing: signals that reach each device; all if left out.
        further: settings of each further device, by the name of its stream.
    """
    timing = timing or Timing()
    world = SimulatedWorld(settings)
    free_run = None if timing.frames == "hardware trigger" else FreeRun(world)
    line = None
    if free_run is not None and timing.frames == "exposure line":
        line = ExposureLine(world, free_run)
    sync = MockSyncBox(world, line)
    arm = MockArm(world, sync, wired=timing.arm == "digital input")
    frames = MockFrameCamera(world, free_run or sync, timing.frames)
    force = None
    if settings.force is not None:
        force = on_cable(MockForceSensor(world, settings.force), "force_sensor", world)
    gripper = None
    if settings.gripper is not None:
        gripper = on_cable(MockGripper(world, settings.gripper), "gripper", world)
    return MockDevices(
        clock=VirtualClock(world),
        arm=on_cable(arm, "arm", world),
        events=on_cable(MockEventCamera(world, sync), "event_camera", world),
        frames=on_cable(frames, "frame_camera", world),
        sync=on_cable(sync, "sync_box", world),
        plate=MockPlate(world),
        operator=SimulatedOperator(world),
        world=world,
        timing=timing,
        force=force,
        gripper=gripper,
        further={
            name: on_cable(_further(name, stream, world, sync), name, world, StreamGone)
            for name, stream in (further or {}).items()
        },
    )


def _further(name: str, stream: Stream, world: SimulatedWorld, box: MockSyncBox) -> FurtherDevice:
    """Build a further device."""
    settings, driver = stream.mock, stream.driver
    if isinstance(driver, SensorDriver) and driver.simulate is not None:
        return driver.simulate(stream.device, VirtualClock(world))
    if isinstance(settings, FurtherEventCamera):
        seen = Identity[MockEventCameraSettings](name, settings, settings.clock_ppm, settings.seed)
        return MockEventCamera(world, box, seen)
    if isinstance(settings, FurtherFrameCamera):
        own = Identity[MockFrameCameraSettings](name, settings, settings.clock_ppm, settings.seed)
        grade = cast(FrameGrade, stream.timing.grade)  # checked against those of its kind
        trigger = box if grade == "hardware trigger" else FreeRun(world, own)
        return MockFrameCamera(world, trigger, grade, own)
    if isinstance(settings, MockForceSensorSettings):
        return MockForceSensor(world, settings, name)
    assert isinstance(settings, Thermometer)
    assert isinstance(stream, ScalarStream)
    return MockThermometer(world, settings, name, stream.unit)
