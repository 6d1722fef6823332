"""The report of an open frame camera, for a look at the rig before a campaign.

Names of Basler's nodes are those of its ace 2 USB family, and older ones after them. None of this
was read from a real camera yet: what a camera does not have is left out or `unknown`.
"""

from __future__ import annotations

from typing import Any

from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.rigs.devices.basler.frame_time import Stamping
from sliplab.rigs.devices.basler.nodes import DEVICE as FRAME_CAMERA
from sliplab.rigs.devices.basler.nodes import Nodes


def basler_health(
    device: Any, nodes: Nodes, stamping: Stamping, shape: tuple[int, int], buffers: int
) -> DeviceHealth:
    """Return the report of an open `InstantCamera` of pypylon; `shape` is (rows, columns).

    Raises:
        RigError: the camera is gone.
    """
    if device.IsCameraDeviceRemoved():
        raise RigError(FRAME_CAMERA, "the camera was unplugged; plug it in and open it again")
    info = device.GetDeviceInfo()
    height, width = shape
    rate = nodes.peek("ResultingFrameRate", "BslResultingAcquisitionFrameRate")
    if rate is None:
        rate = nodes.peek("ResultingFrameRateAbs")
    notes = [f"region {width} x {height} px"]
    if rate is not None:
        notes.append(f"at most {rate:.0f} frames/s")
    if device.IsGrabbing():
        free = device.NumQueuedBuffers.Value + device.NumEmptyBuffers.Value
        notes.append(f"{free} of {buffers} buffers free")
    else:
        notes.append(f"{buffers} buffers")
    if (speed := nodes.peek("BslUSBSpeedMode")) is not None:
        notes.append(f"link {speed}")
    if (limit := nodes.peek("DeviceLinkThroughputLimit")) is not None:
        notes.append(f"link limited to {limit / 1e6:.0f} MB/s")
    celsius = nodes.peek("DeviceTemperature", "TemperatureAbs")
    return DeviceHealth(
        device=FRAME_CAMERA,
        model=info.GetModelName() or UNKNOWN,
        serial=info.GetSerialNumber() or UNKNOWN,
        firmware=str(nodes.peek("DeviceFirmwareVersion", "DeviceVersion") or UNKNOWN),
        temperature_c=None if celsius is None else float(celsius),
        clock=stamping.means
        if stamping.means == stamping.grade
        else f"{stamping.means}, grade {stamping.grade}",
        notes=tuple(notes),
    )
