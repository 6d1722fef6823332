"""Basler cameras through pylon; `frame_time` determines how frames are time-stamped."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.driver import FrameCameraDriver, SceneFrames, lazy

if TYPE_CHECKING:
    from sliplab.rigs.core.capabilities import FrameCamera

_camera = lazy("sliplab.plugins.devices.basler.driver:BaslerCamera")


def _ping(settings: BaslerSettings) -> str | None:
    from sliplab.plugins.devices.basler.driver import find_device_info

    find_device_info(settings.serial)
    return None


def _fake(
    settings: BaslerSettings, px_per_mm: float, scene: SceneFrames, mid_exposure_ns: int
) -> FrameCamera:
    from sliplab.plugins.devices.basler.fake_live import LiveBasler

    device = LiveBasler(scene, mid_exposure_ns, settings.sync_line or 1)
    return _camera(settings.model_copy(update={"px_per_mm": px_per_mm}), device)


DRIVER = FrameCameraDriver(
    name="basler",
    title="Basler",
    settings=BaslerSettings,
    libraries=("pypylon",),
    ping=_ping,
    build=lambda settings, px_per_mm: _camera(settings.model_copy(update={"px_per_mm": px_per_mm})),
    fake=_fake,
    unplug=lambda camera: camera.device.unplug(),
)
