"""Declaration of the driver; cheap to import."""

from __future__ import annotations

from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.driver import FrameCameraDriver, lazy

DRIVER = FrameCameraDriver(
    name="uvc",
    title="USB camera",
    settings=UvcSettings,
    libraries=("cv2",),
    address=lambda settings: settings.device,
    ping=lazy("sliplab.plugins.uvc.driver:why_unreachable"),
    build=lazy("sliplab.plugins.uvc.driver:UvcCamera"),
    fake=lazy("sliplab.plugins.uvc.fake:FedCamera"),
    unplug=lambda camera: camera.unplug(),
    grade="host arrival",
)
