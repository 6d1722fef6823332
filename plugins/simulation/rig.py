"""Assembly of a rig on simulated devices, as a rig file with `driver: mock` describes it."""

from __future__ import annotations

from sliplab.plugins.simulation.devices import MockDevices, build_mock
from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.simulation.truth import plate_course, watch_plate
from sliplab.protocols.nuisances import TrialNuisances
from sliplab.rigs.build import (
    ShouldStop,
    force_limit,
    further_stream,
    never,
    plate_limits,
    taught_frame,
)
from sliplab.rigs.core.capabilities import PlateCourse, Truth
from sliplab.rigs.core.guard import Guard
from sliplab.rigs.core.rig import Rig
from sliplab.rigs.rig_file import RigFile
from sliplab.storage.streams import Sink


class _MockSimulation:
    """The simulated world, in the time of the arm controller's clock."""

    def __init__(self, devices: MockDevices) -> None:
        self._devices = devices

    def begin_trial(self, seed: int, nuisances: TrialNuisances | None = None) -> None:
        """Draw what varies by trial from `seed`."""
        self._devices.begin_trial(seed, nuisances)

    def sink(self, sink: Sink) -> Sink:
        """Return the sink of the recording in this world."""
        return self._devices.sink(sink)

    def truth(self, reference_arm_ns: int, hold_arm_ns: int | None = None) -> Truth:
        """Return the ground truth of a trial, counted from these times."""
        clock = self._devices.world.clocks.arm
        hold_ns = None if hold_arm_ns is None else int(clock.to_device(hold_arm_ns))
        return self._devices.truth(int(clock.to_device(reference_arm_ns)), hold_ns)

    def watch_plate(self) -> None:
        """Keep the forces on the plate from now on."""
        watch_plate(self._devices.world)

    def plate_course(self, since_arm_ns: int) -> PlateCourse:
        """Return the plate's course since an arm controller time."""
        world = self._devices.world
        return plate_course(world, int(world.clocks.arm.to_device(since_arm_ns)))


def build_rig(file: RigFile, should_stop: ShouldStop) -> Rig:
    """Build the simulated devices that a rig file describes, and their rig."""
    devices = build_mock(scene_of(file), file.timing, file.streams)
    return simulated_rig(file, devices, should_stop)


def simulated_rig(file: RigFile, devices: MockDevices, should_stop: ShouldStop = never) -> Rig:
    """Build the rig that a rig file describes on the given simulated devices."""
    return Rig(
        name=file.name,
        clock=devices.clock,
        arm=devices.arm,
        event_camera=devices.events if "events" in file.cameras else None,
        frame_camera=devices.frames if "frames" in file.cameras else None,
        sync=devices.sync,
        operator=devices.operator,
        plate_frame=taught_frame(file),
        poll_s=float(file.poll),
        timing=file.timing,
        touch_mm=file.calibration.touch_depth,
        centre_px=file.calibration.centre_px,
        plate=devices.plate,
        force=devices.force,
        force_limit_n=force_limit(file),
        guard=Guard(None, plate_limits(file)),
        further=tuple(
            further_stream(name, file.streams[name], device, taught_frame(file))
            for name, device in devices.further.items()
        ),
        gripper=devices.gripper,
        grip_opening_mm=file.grip_opening_mm or 0.0,
        simulation=_MockSimulation(devices),
        should_stop=should_stop,
    )
