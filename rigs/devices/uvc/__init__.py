"""USB cameras of the video class (UVC), through OpenCV: what most optical tactile sensors have."""

from __future__ import annotations

from sliplab.rigs.core.driver import FrameCameraDriver, lazy
from sliplab.rigs.devices.uvc.settings import UvcSettings

DRIVER = FrameCameraDriver(
    name="uvc",
    title="USB camera",
    settings=UvcSettings,
    libraries=("cv2",),
    address=lambda settings: settings.device,
    ping=lazy("sliplab.rigs.devices.uvc.driver:why_unreachable"),
    build=lazy("sliplab.rigs.devices.uvc.driver:UvcCamera"),
    fake=lazy("sliplab.rigs.devices.uvc.fake:FedCamera"),
    unplug=lambda camera: camera.unplug(),
    grade="host arrival",
)
