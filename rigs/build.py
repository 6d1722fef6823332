"""From a rig file to a rig that can be run: the one place that knows which driver is which."""

from __future__ import annotations

from typing import Any

from rigs.mock.devices import MockDevices, build_mock
from rigs.plate_frame import PlateFrame
from rigs.rig import Rig
from rigs.rig_file import RigFile
from storage.streams import Sink


class _MockSimulation:
    """The simulated world, asked on the arm controller's clock."""

    def __init__(self, devices: MockDevices) -> None:
        self._devices = devices

    def begin_trial(self, seed: int) -> None:
        """Draw what varies by trial from `seed`."""
        self._devices.begin_trial(seed)

    def sink(self, sink: Sink) -> Sink:
        """Where the recording goes in this world."""
        return self._devices.sink(sink)

    def truth(self, reference_arm_ns: int) -> dict[str, Any]:
        """What really happened after that moment."""
        clock = self._devices.world.clocks.arm
        return self._devices.truth(int(clock.to_device(reference_arm_ns)))


def build_rig(file: RigFile) -> Rig:
    """The rig that a rig file describes, not connected yet."""
    return simulated_rig(file, build_mock(file.mock, file.timing))


def simulated_rig(file: RigFile, devices: MockDevices) -> Rig:
    """The rig that a rig file describes, on simulated devices that somebody else made."""
    plane = file.calibration.contact_plane
    return Rig(
        name=file.name,
        clock=devices.clock,
        arm=devices.arm,
        events=devices.events,
        frames=devices.frames,
        sync=devices.sync,
        operator=devices.operator,
        frame=PlateFrame.taught((plane.centre, plane.right, plane.above)).with_zero(
            file.calibration.zero_mm
        ),
        poll_s=float(file.poll),
        timing=file.timing,
        touch_mm=file.calibration.touch_depth,
        centre_px=file.calibration.centre_px,
        plate=devices.plate,
        simulation=_MockSimulation(devices),
    )
