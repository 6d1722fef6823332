"""Settings of a Basler camera in a rig file; the driver queries the device for the rest."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import rule
from sliplab.rigs.core.device_settings import FrameCameraSettings

FrameTrigger = Literal["hardware", "software", "free run"]


class BaslerSettings(FrameCameraSettings):
    """The camera that looks through the plate."""

    driver: Literal["basler"] = "basler"
    serial: str | None = None
    """Serial number; if left out, the only connected camera."""
    px_per_mm: float | None = Field(default=None, gt=0, le=1000)
    """Pixels per millimetre of the plate; rig files use `scale_px_per_mm` instead."""
    exposure_us: float = Field(default=2000.0, ge=1, le=1_000_000)
    """Exposure, microseconds; the camera may round it, and the rounded value applies."""
    gain_db: float = Field(default=0.0, ge=0, le=48)
    """Gain, dB."""
    user_set: str = "Default"
    """User set that is loaded before settings are written; `Default` is the factory set."""
    rate_hz: float = Field(default=100.0, gt=0, le=1000)
    """Frame rate: the camera's own in free run, else the highest trigger rate."""
    trigger: FrameTrigger = "hardware"
    """`hardware`: a rising edge on `trigger_line`. `software`: the host triggers each frame."""
    trigger_line: str = "Line1"
    """Name of the input that is wired to the sync box's ticks."""
    sync_line: int | None = Field(default=None, ge=1, le=8)
    """Number of the input that is wired to the sync box's code; its level is sent as a chunk."""
    exposure_line: str | None = None
    """Name of the output that signals exposures to the sync box; None where it is not wired."""
    back_pressure_s: float = Field(default=5.0, ge=0.1, le=60)
    """Buffered seconds between calls of `read`: half in pylon's buffers, half in a queue."""
    late_s: float = Field(default=0.1, gt=0, le=10)
    """Delay after which a frame counts as late, seconds."""
    first_frame_s: float = Field(default=5.0, ge=0.2, le=60)
    """Timeout for the first frame in free run, seconds: camera and pylon need time to set up
    buffers. A triggered camera may wait for its first trigger without limit."""
    stall_s: float = Field(default=1.0, ge=0.2, le=60)
    """Timeout for each later frame, seconds."""

    @rule
    def _exposure_fits(self) -> BaslerSettings:
        if self.exposure_us * self.rate_hz > 1e6:
            raise KeyedError(
                ".exposure_us",
                f"{self.exposure_us:g}",
                f"must be at most {1e6 / self.rate_hz:g}, the period of rate_hz = {self.rate_hz:g}",
            )
        return self

    @rule
    def _lines_differ(self) -> BaslerSettings:
        inputs = {"sync_line": f"Line{self.sync_line}"}
        if self.trigger == "hardware":
            inputs["trigger_line"] = self.trigger_line
        for key, line in inputs.items():
            if self.exposure_line == line:
                raise KeyedError(".exposure_line", line, f"is already used as an input: {key}")
        if self.trigger == "hardware" and self.trigger_line == inputs["sync_line"]:
            raise KeyedError(
                ".sync_line",
                self.sync_line,
                "must differ from trigger_line: this line carries the code",
            )
        return self
