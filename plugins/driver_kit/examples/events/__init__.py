"""Example event camera: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.arm_settings import Port
from sliplab.rigs.core.capabilities import EventCamera
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import EventCameraDriver, FakeEventCamera
from sliplab.rigs.core.network import answers


class ExampleEventsSettings(DriverSettings):
    """An event camera that sends packets over TCP."""

    driver: Literal["example_events"] = "example_events"
    host: Host = "127.0.0.1"
    """Address of the camera."""
    port: Port = 7400
    """TCP port of the camera."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """Silence of a running camera that is a fault, seconds."""


def build(settings: ExampleEventsSettings) -> EventCamera:
    """Open the camera, not streaming yet. Raises RigError."""
    from sliplab.plugins.driver_kit.examples.events.driver import ExampleEvents

    return ExampleEvents(settings)


def fake(size: tuple[int, int]) -> FakeEventCamera:
    """Serve a fake with so many columns and rows on a free port."""
    from sliplab.plugins.driver_kit.examples.events.fake import FakeExampleEvents

    return FakeExampleEvents(size)


def reach(settings: ExampleEventsSettings, address: Any) -> ExampleEventsSettings:
    """Return settings that reach a fake."""
    return settings.model_copy(update={"host": address[0], "port": address[1]})


DRIVER = EventCameraDriver(
    name="example_events",
    title="Example event camera",
    settings=ExampleEventsSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=lambda settings: {f"camera-{settings.host}-{settings.port}": "the event camera"},
    build=build,
    fake=fake,
    reach=reach,
)
