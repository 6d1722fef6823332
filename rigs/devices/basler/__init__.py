"""Basler cameras through pylon; `frame_time` determines how frames are time-stamped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.rigs.core.driver import FrameCameraDriver, SceneFrames
from sliplab.rigs.devices.basler.settings import BaslerSettings

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import FrameCamera


def _build(settings: BaslerSettings, px_per_mm: float) -> FrameCamera:
    from sliplab.rigs.devices.basler.driver import BaslerCamera

    return BaslerCamera(settings.model_copy(update={"px_per_mm": px_per_mm}))


def _ping(settings: BaslerSettings) -> str | None:
    from sliplab.rigs.devices.basler.driver import find_device_info

    find_device_info(settings.serial)
    return None


def _fake(
    settings: BaslerSettings, px_per_mm: float, scene: SceneFrames, mid_exposure_ns: int
) -> FrameCamera:
    from sliplab.rigs.devices.basler.driver import BaslerCamera
    from sliplab.rigs.devices.basler.fake_live import LiveBasler

    device = LiveBasler(scene, mid_exposure_ns, settings.sync_line or 1)
    return BaslerCamera(settings.model_copy(update={"px_per_mm": px_per_mm}), device)


def _unplug(camera: FrameCamera) -> None:
    from sliplab.rigs.devices.basler.driver import BaslerCamera

    assert isinstance(camera, BaslerCamera)
    camera.device.unplug()


DRIVER = FrameCameraDriver(
    name="basler",
    title="Basler",
    settings=BaslerSettings,
    libraries=("pypylon",),
    ping=_ping,
    build=_build,
    fake=_fake,
    unplug=_unplug,
)
