"""Settings of a DVXplorer in a rig file; the driver asks the device for everything else."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.core.address import Host
from sliplab.rigs.core.device_settings import DriverSettings

Readout = Literal[
    "constant 100", "constant 200", "constant 500", "constant 1000",
    "variable 2000", "variable 5000", "variable 10000", "variable 15000",
]  # fmt: skip
"""Read-outs that lose nothing of themselves, by their names in dv-processing 2.0.4."""


class UsbCamera(StrictModel):
    """A camera on this computer."""

    kind: Literal["usb"] = "usb"
    serial: str | None = None
    """Serial number; the only DVXplorer where none is given."""
    readout: Readout = "constant 1000"
    """Scans a second; at a constant rate every pixel's time is regular (docs/clocks.md)."""
    contrast_on: int | None = Field(default=None, ge=0, le=255)
    """Contrast threshold of brighter events, the camera's unit; None leaves its own."""
    contrast_off: int | None = Field(default=None, ge=0, le=255)
    """Contrast threshold of darker events, the camera's unit; None leaves its own."""


class NetworkStream(StrictModel):
    """Two streams of dv-processing on the network, one of events and one of triggers."""

    kind: Literal["network"] = "network"
    host: Host = "127.0.0.1"
    """Address of the computer that serves them."""
    events_port: int = Field(ge=1, le=65_535)
    triggers_port: int = Field(ge=1, le=65_535)


class DvxplorerSettings(DriverSettings):
    """The event camera inside the sensor."""

    driver: Literal["dvxplorer"] = "dvxplorer"
    source: Annotated[UsbCamera | NetworkStream, Field(discriminator="kind")] = UsbCamera()
    noise_filter_us: int | None = Field(default=None, ge=1, le=1_000_000)
    """Drop events without a neighbour within so many microseconds; None keeps all of them."""
    buffer_mb: float = Field(default=512.0, ge=1, le=65_536)
    """Memory for events that nobody has read yet, megabytes (13 bytes an event)."""
    gap_s: float = Field(default=0.05, gt=0, le=60)
    """Silence between two events, on the camera's clock, that counts as a gap, seconds."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """A running camera that sends neither event nor trigger for so long is a fault, seconds."""
