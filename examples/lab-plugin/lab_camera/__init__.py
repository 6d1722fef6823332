"""The lab camera: an event camera that streams packets over TCP.

Imported whenever a rig file names it, by `sliplab plan` too: the driver itself is loaded when the
device is made.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.capabilities import EventCamera
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import EventCameraDriver, FakeEventCamera
from sliplab.rigs.core.network import answers


class LabCameraSettings(DriverSettings):
    """An event camera that streams packets over TCP."""

    driver: Literal["lab_camera"] = "lab_camera"
    host: Host = "127.0.0.1"
    """Address of the computer that serves the camera."""
    port: int = Field(default=7400, ge=1, le=65_535)
    """TCP port there."""
    buffer_mb: float = Field(default=256.0, ge=1, le=65_536)
    """Memory for events that nobody has read yet, megabytes (13 bytes an event)."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """A streaming camera that sends nothing for so long is a fault, seconds."""


def build(settings: LabCameraSettings) -> EventCamera:
    """Open the camera, not streaming yet. Raises RigError."""
    from lab_camera.driver import LabCamera

    return LabCamera(settings)


def fake(size: tuple[int, int]) -> FakeEventCamera:
    """Serve a fake of so many columns and rows on a free port."""
    from lab_camera.fake import FakeLabCamera

    return FakeLabCamera(size)


def reach(settings: LabCameraSettings, address: Any) -> LabCameraSettings:
    """Return settings that reach a fake."""
    host, port = address
    return settings.model_copy(update={"host": host, "port": port})


def locks(settings: LabCameraSettings) -> dict[str, str]:
    """Return the lock of the camera: it serves one client."""
    where = f"{settings.host.lower()}:{settings.port}"
    return {f"camera-{where}": f"the event camera at {where}"}


DRIVER = EventCameraDriver(
    name="lab_camera",
    title="Lab camera",
    settings=LabCameraSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=locks,
    build=build,
    fake=fake,
    reach=reach,
)
