"""From a rig file to a rig that can be run: the one place that knows which driver is which."""

from __future__ import annotations

from rigs.mock.devices import build_mock
from rigs.plate_frame import PlateFrame
from rigs.rig import Rig
from rigs.rig_file import RigFile


def build_rig(file: RigFile) -> Rig:
    """The rig that a rig file describes, not connected yet."""
    plane = file.calibration.contact_plane
    devices = build_mock(file.mock)
    return Rig(
        name=file.name,
        clock=devices.clock,
        arm=devices.arm,
        events=devices.events,
        frames=devices.frames,
        sync=devices.sync,
        operator=devices.operator,
        frame=PlateFrame.taught((plane.centre, plane.right, plane.above)),
        poll_s=float(file.poll),
        plate=devices.plate,
        simulation=devices.world,
    )
