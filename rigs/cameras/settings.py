"""What a rig file says of the real cameras; the drivers ask the device for everything else."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from sliplab.protocols.yaml_file import KeyedError, StrictModel
from sliplab.rigs.address import Host

FrameTrigger = Literal["hardware", "software", "free run"]
Readout = Literal[
    "constant 100", "constant 200", "constant 500", "constant 1000",
    "variable 2000", "variable 5000", "variable 10000", "variable 15000",
]  # fmt: skip
"""Read-outs that lose nothing of themselves, by their names in dv-processing 2.0.4."""


class BaslerSettings(StrictModel):
    """The camera that looks through the plate."""

    driver: Literal["basler"] = "basler"
    serial: str | None = None
    """Serial number; the only camera where none is given."""
    px_per_mm: float | None = Field(default=None, gt=0, le=1000)
    """Pixels for a millimetre of the plate; a rig file says it elsewhere (`scale_px_per_mm`)."""
    exposure_us: float = Field(default=2000.0, ge=1, le=1_000_000)
    """Exposure, microseconds; the camera may round it, and what it says then counts."""
    gain_db: float = Field(default=0.0, ge=0, le=48)
    """Gain, dB."""
    user_set: str = "Default"
    """Set that is loaded from the camera before all else is written; `Default` is the maker's."""
    rate_hz: float = Field(default=100.0, gt=0, le=1000)
    """Frames a second: its own rate in free run, else the most that the triggers ask for."""
    trigger: FrameTrigger = "hardware"
    """`hardware`: a rising edge on `trigger_line`. `software`: the host asks for each frame."""
    trigger_line: str = "Line1"
    """Name of the input that is wired to the sync box's ticks."""
    sync_line: int | None = Field(default=None, ge=1, le=8)
    """Number of the input that is wired to the sync box's code; its level comes as a chunk."""
    exposure_line: str | None = None
    """Name of the output that tells the sync box of exposures; None where it is not wired."""
    back_pressure_s: float = Field(default=5.0, ge=0.1, le=60)
    """Seconds for which nobody need call `read`: half in pylon's buffers, half in a queue."""
    late_s: float = Field(default=0.1, gt=0, le=10)
    """A frame that arrives by this much after its time counts as late, seconds."""
    first_frame_s: float = Field(default=5.0, ge=0.2, le=60)
    """In free run, no frame for so long after the start is a fault, seconds: a camera and pylon
    need time to set up buffers. Triggered, it may wait for ever for its first trigger."""
    stall_s: float = Field(default=1.0, ge=0.2, le=60)
    """Silence for so long after the first frame is a fault, seconds."""

    @model_validator(mode="after")
    def _exposure_fits(self) -> BaslerSettings:
        if self.exposure_us * self.rate_hz > 1e6:
            raise KeyedError(
                ".exposure_us",
                f"{self.exposure_us:g}",
                f"must be at most {1e6 / self.rate_hz:g}, the period of rate_hz = {self.rate_hz:g}",
            )
        return self

    @model_validator(mode="after")
    def _lines_differ(self) -> BaslerSettings:
        inputs = {"sync_line": f"Line{self.sync_line}"}
        if self.trigger == "hardware":
            inputs["trigger_line"] = self.trigger_line
        for key, line in inputs.items():
            if self.exposure_line == line:
                raise KeyedError(".exposure_line", line, f"is an input already: {key}")
        if self.trigger == "hardware" and self.trigger_line == inputs["sync_line"]:
            raise KeyedError(
                ".sync_line",
                self.sync_line,
                "must be another line than trigger_line: it has a code",
            )
        return self


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


class DvxplorerSettings(StrictModel):
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
