"""Settings of a DVXplorer in a rig file; the driver queries the device for the rest."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.core.address import Host
from sliplab.rigs.core.device_settings import DriverSettings

Readout = Literal[
    "constant 100",
    "constant 200",
    "constant 500",
    "constant 1000",
    "variable 2000",
    "variable 5000",
    "variable 10000",
    "variable 15000",
]
"""Read-out modes that drop no events by design, by their names in dv-processing 2.0.4."""


class UsbCamera(StrictModel):
    """A camera connected to this computer."""

    kind: Literal["usb"] = "usb"
    serial: str | None = None
    """Serial number; if left out, the only connected DVXplorer."""
    readout: Readout = "constant 1000"
    """Read-out scans per second; a constant rate gives regular pixel times (docs/clocks.md)."""
    contrast_on: int | None = Field(default=None, ge=0, le=255)
    """Contrast threshold of ON events, in the camera's unit; None keeps the camera's own."""
    contrast_off: int | None = Field(default=None, ge=0, le=255)
    """Contrast threshold of OFF events, in the camera's unit; None keeps the camera's own."""


class NetworkStream(StrictModel):
    """Two streams of dv-processing on the network, one of events and one of triggers."""

    kind: Literal["network"] = "network"
    host: Host = "127.0.0.1"
    """Address of the computer that serves the streams."""
    events_port: int = Field(ge=1, le=65_535)
    triggers_port: int = Field(ge=1, le=65_535)


class DvxplorerSettings(DriverSettings):
    """The event camera inside the sensor."""

    driver: Literal["dvxplorer"] = "dvxplorer"
    source: Annotated[UsbCamera | NetworkStream, Field(discriminator="kind")] = UsbCamera()
    noise_filter_us: int | None = Field(default=None, ge=1, le=1_000_000)
    """Drop events without a neighbour within this time, microseconds; None keeps all events."""
    buffer_mb: float = Field(default=512.0, ge=1, le=65_536)
    """Buffer for unread events, megabytes (13 bytes per event)."""
    gap_s: float = Field(default=0.05, gt=0, le=60)
    """Interval between two events, on the camera's clock, that counts as a gap, seconds."""
    stall_s: float = Field(default=1.0, ge=0.1, le=60)
    """Timeout for a running camera to send an event or a trigger, seconds."""
