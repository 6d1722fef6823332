"""Example scalar sensor: settings and declaration.

Imported whenever a rig file names the driver, by `sliplab plan` too: keep it cheap. The driver
itself, and a maker's library, are imported when the device is made.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.rigs.core.capabilities import ScalarSensor
from sliplab.rigs.core.device_settings import DriverSettings
from sliplab.rigs.core.driver import FakeSensor, SensorDriver
from sliplab.rigs.core.network import serial_port


class ExampleScalarSettings(DriverSettings):
    """A thermometer that sends lines of text on a serial port."""

    driver: Literal["example_scalar"] = "example_scalar"
    port: str = Field(default="/dev/ttyACM0", min_length=1)
    """Serial port; one below `/dev/serial/by-id` stays the same."""
    baud: int = Field(default=115_200, ge=50, le=12_000_000)
    stall_s: float = Field(default=0.5, ge=0.1, le=3600)
    """Silence of a running sensor that is a fault, seconds."""


def build(settings: ExampleScalarSettings) -> ScalarSensor:
    """Make the sensor, not connected yet."""
    from sliplab.plugins.driver_kit.examples.scalar.driver import ExampleScalar

    return ExampleScalar(settings)


def fake(settings: ExampleScalarSettings) -> FakeSensor:
    """Make a fake on a pseudo terminal."""
    from sliplab.plugins.driver_kit.examples.scalar.fake import FakeExampleScalar

    return FakeExampleScalar()


def reach(settings: ExampleScalarSettings, address: str) -> ExampleScalarSettings:
    """Return settings that reach a fake."""
    return settings.model_copy(update={"port": address})


DRIVER = SensorDriver(
    name="example_scalar",
    title="Example scalar sensor",
    settings=ExampleScalarSettings,
    libraries=("serial",),
    ping=lambda settings: serial_port(settings.port),
    address=lambda settings: settings.port,
    locks=lambda settings: {f"serial-{settings.port}": f"the port {settings.port}"},
    build=build,
    fake=fake,
    reach=reach,
)
