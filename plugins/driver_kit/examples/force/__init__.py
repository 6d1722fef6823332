"""Example force sensor: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field

from sliplab.rigs.core.address import Host
from sliplab.rigs.core.arm_settings import Port
from sliplab.rigs.core.capabilities import Arm, ForceSensor
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import FakeForceSensor, ForceSensorDriver
from sliplab.rigs.core.network import answers


class ExampleForceSettings(DriverSettings):
    """A force sensor that sends samples over TCP."""

    driver: Literal["example_force"] = "example_force"
    host: Host = "127.0.0.1"
    """Address of the sensor."""
    port: Port = 7500
    """TCP port of the sensor."""
    stall_s: float = Field(default=0.5, ge=0.1, le=60)
    """Silence of a running sensor that is a fault, seconds."""


def build(settings: ExampleForceSettings, arm: Arm) -> ForceSensor:
    """Make the sensor, not connected yet; it does not belong to the arm."""
    from sliplab.plugins.driver_kit.examples.force.driver import ExampleForce

    return ExampleForce(settings)


def fake(settings: ExampleForceSettings) -> FakeForceSensor:
    """Serve a fake on a free port."""
    from sliplab.plugins.driver_kit.examples.force.fake import FakeExampleForce

    return FakeExampleForce()


def reach(settings: ExampleForceSettings, address: Any) -> ExampleForceSettings:
    """Return settings that reach a fake."""
    return settings.model_copy(update={"host": address[0], "port": address[1]})


DRIVER = ForceSensorDriver(
    name="example_force",
    title="Example force sensor",
    settings=ExampleForceSettings,
    ping=lambda settings: answers(settings.host, settings.port),
    address=lambda settings: f"{settings.host}:{settings.port}",
    locks=lambda settings: {f"force-{settings.host}-{settings.port}": "the force sensor"},
    build=build,
    fake=fake,
    reach=reach,
)
