"""USB cameras of the video class (UVC), through OpenCV: what most optical tactile sensors have."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.rigs.core.driver import FrameCameraDriver, SceneFrames
from sliplab.rigs.devices.uvc.settings import UvcSettings

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import FrameCamera


def _build(settings: UvcSettings, px_per_mm: float) -> FrameCamera:
    from sliplab.rigs.devices.uvc.driver import UvcCamera

    return UvcCamera(settings, px_per_mm)


def _ping(settings: UvcSettings) -> str | None:
    from sliplab.rigs.devices.uvc.driver import why_unreachable

    return why_unreachable(settings.device)


def _fake(
    settings: UvcSettings, px_per_mm: float, scene: SceneFrames, mid_exposure_ns: int
) -> FrameCamera:
    from sliplab.rigs.devices.uvc.fake import FedCamera

    return FedCamera(settings, px_per_mm, scene)


def _unplug(camera: FrameCamera) -> None:
    from sliplab.rigs.devices.uvc.fake import FedCamera

    assert isinstance(camera, FedCamera)
    camera.unplug()


DRIVER = FrameCameraDriver(
    name="uvc",
    title="USB camera",
    settings=UvcSettings,
    libraries=("cv2",),
    address=lambda settings: settings.device,
    ping=_ping,
    build=_build,
    fake=_fake,
    unplug=_unplug,
    grade="host arrival",
)
