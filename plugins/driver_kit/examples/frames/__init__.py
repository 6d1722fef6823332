"""Example frame camera: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.arm_settings import Port
from sliplab.rigs.core.capabilities import FrameCamera
from sliplab.rigs.core.device_settings import FrameCameraSettings
from sliplab.rigs.core.driver import FrameCameraDriver, SceneFrames
from sliplab.rigs.core.network import answers


class ExampleFramesSettings(FrameCameraSettings):
    """A frame camera that sends images over TCP."""

    driver: Literal["example_frames"] = "example_frames"
    host: Host = "127.0.0.1"
    """Address of the camera."""
    port: Port = 7600
    """TCP port of the camera."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """Silence of a grabbing camera that is a fault, seconds."""


def build(settings: ExampleFramesSettings, px_per_mm: float) -> FrameCamera:
    """Open the camera, not grabbing yet. Raises RigError."""
    from sliplab.plugins.driver_kit.examples.frames.driver import ExampleFrames

    return ExampleFrames(settings, px_per_mm)


def fake(
    settings: ExampleFramesSettings, px_per_mm: float, scene: SceneFrames, mid_exposure_ns: int
) -> FrameCamera:
    """Open the driver on a fake that shows a scene."""
    from sliplab.plugins.driver_kit.examples.frames.fake import FakedExampleFrames

    return FakedExampleFrames(settings, px_per_mm, scene, mid_exposure_ns)


def unplug(camera: Any) -> None:
    """Unplug a camera that `fake` has opened."""
    camera.fake.close()


DRIVER = FrameCameraDriver(
    name="example_frames",
    title="Example frame camera",
    settings=ExampleFramesSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=lambda settings: {f"camera-{settings.host}-{settings.port}": "the frame camera"},
    build=build,
    fake=fake,
    unplug=unplug,
)
