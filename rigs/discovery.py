"""Discovery: check that a rig's devices can be reached, without taking control of any."""

from __future__ import annotations

from collections.abc import Mapping

from sliplab.protocols.later import need
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.device_section import DeviceSettings
from sliplab.rigs.rig_file import RigFile
from sliplab.rigs.stream_settings import Stream, named_drivers
from sliplab.storage.streams import FRAMES_KIND


def need_libraries(devices: DeviceSettings, streams: Mapping[str, Stream] | None = None) -> None:
    """Check that the vendor libraries of a rig's drivers are installed; none is imported.

    Raises:
        ModuleNotFoundError: one of them is not installed.
    """
    for _, driver, _settings in named_drivers(devices, streams or {}):
        for name in driver.libraries:
            need(name)


def need_video(file: RigFile) -> None:
    """Check that what encodes a rig's frames is installed, and what draws simulated ones.

    Raises:
        ModuleNotFoundError: one of them is not installed.
    """
    further = any(stream.kind == FRAMES_KIND for stream in file.streams.values())
    if further or ("frames" in file.cameras and file.frame_source == "video"):
        need("av")
        if file.simulated:
            need("cv2")


def ping_devices(
    devices: DeviceSettings, streams: Mapping[str, Stream] | None = None
) -> dict[str, str | None]:
    """Return for each device of a rig None if it can be reached, else the reason and what to check.

    Each connection is closed as soon as the device has answered; takes some seconds.

    Raises:
        ModuleNotFoundError: a vendor library is not installed.
    """
    need_libraries(devices, streams)
    found: dict[str, str | None] = {}
    for part, driver, settings in named_drivers(devices, streams or {}):
        try:
            found[part] = driver.ping(settings)
        except RigError as error:
            found[part] = str(error).removeprefix(f"{error.device}: ")
        except Exception as error:  # a vendor library may raise anything
            found[part] = str(error) or type(error).__name__
    if devices.sync_box is None:
        found["sync box"] = "the rig file names no port"
    return found
