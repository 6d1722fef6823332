"""What open cameras say of themselves, for a look at the rig before a campaign.

Names of Basler's nodes are those of its ace 2 USB family, and older ones after them. None of this
was read from a real camera yet: what a camera does not have is left out or `unknown`.
"""

from __future__ import annotations

from typing import Any

from rigs.cameras.event_source import DEVICE as EVENT_CAMERA
from rigs.cameras.event_source import EventSource
from rigs.cameras.nodes import DEVICE as FRAME_CAMERA
from rigs.cameras.nodes import Nodes
from rigs.cameras.settings import DvxplorerSettings
from rigs.cameras.stamps import Stamping
from rigs.capabilities import DeviceHealth, RigError

UNKNOWN = "unknown"


def basler_health(
    device: Any, nodes: Nodes, stamping: Stamping, shape: tuple[int, int], buffers: int
) -> DeviceHealth:
    """Of an open `InstantCamera` of pypylon whose region is `shape` (height, width), pixels.

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


def dvxplorer_health(source: EventSource, settings: DvxplorerSettings) -> DeviceHealth:
    """Of an open event camera, or of the streams that stand for one.

    Its only thermometer is the IMU's, and the IMU is off.

    Raises:
        RigError: the camera is gone.
    """
    if not (source.events.isRunning() and source.triggers.isRunning()):
        raise RigError(EVENT_CAMERA, "the connection is gone; look at its cable")
    width, height = source.resolution
    notes = [f"{width} x {height} px", f"{settings.buffer_mb:g} MB for events nobody has read"]
    serial = firmware = UNKNOWN
    camera = source.camera
    if camera is not None:
        try:
            serial = str(camera.getSerialNumber())
            firmware = f"{camera.getFirmwareVersion()}, logic {camera.getLogicVersion()}"
            notes.append(f"link {_said(camera.getConnectionSpeed()).removeprefix('libusb speed ')}")
            notes.append(f"read-out {_said(camera.getReadoutFPS())}")
        except RuntimeError as error:
            raise RigError(EVENT_CAMERA, f"it does not answer: {error}") from None
    else:
        notes.append("from the network")
    return DeviceHealth(
        device=EVENT_CAMERA,
        model=source.name,
        serial=serial,
        firmware=firmware,
        temperature_c=None,
        clock="the camera's, 1 us",
        notes=tuple(notes),
    )


def _said(choice: Any) -> str:
    return str(choice.name).lower().replace("_", " ")
