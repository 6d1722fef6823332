"""Settings of a USB camera in a rig file; what the camera does not take is refused."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import rule
from sliplab.rigs.core.device_settings import FrameCameraSettings


class UvcSettings(FrameCameraSettings):
    """A USB camera, which runs by itself and stamps nothing that could be trusted."""

    driver: Literal["uvc"] = "uvc"
    device: str = Field(default="/dev/video0", min_length=1)
    """Path of the camera; `/dev/v4l/by-id/...` stays the same when others are plugged in. Any
    other file, pipe or URL that OpenCV opens is read as a stream, on which nothing can be set."""
    width_px: int = Field(default=1280, ge=16, le=8192)
    height_px: int = Field(default=720, ge=16, le=8192)
    """Format of the camera, columns and rows; a region is cut from its middle."""
    pixel_format: Literal["MJPG", "YUYV", "GREY"] = "MJPG"
    """`MJPG`: compressed, for large formats at USB 2. The other two keep every grey level."""
    rate_hz: float = Field(default=30.0, gt=0, le=1000)
    """Frames a second that the camera is set to; `frame_camera.rate_hz` of the rig file says it
    to the rest of SlipLab."""
    exposure_us: Annotated[float, Field(ge=100, le=1_000_000)] = 5000.0
    """Exposure, microseconds; V4L2 counts it in 100."""
    gain: float | None = Field(default=None, ge=0, le=10_000)
    """Gain in the camera's own units; left out, the camera's stays as it is."""
    focus: float | None = Field(default=None, ge=0, le=10_000)
    """Focus in the camera's own units; left out, it stays as it is, without autofocus."""
    back_pressure_s: float = Field(default=5.0, ge=0.1, le=60)
    """Buffered seconds between calls of `read`."""
    first_frame_s: float = Field(default=5.0, ge=0.2, le=60)
    """Timeout for the first frame after the start, seconds."""
    stall_s: float = Field(default=1.0, ge=0.2, le=60)
    """Timeout for each later frame, seconds."""

    @rule
    def _exposure_fits(self) -> UvcSettings:
        if self.exposure_us * self.rate_hz > 1e6:
            raise KeyedError(
                ".exposure_us",
                f"{self.exposure_us:g}",
                f"must be at most {1e6 / self.rate_hz:g}, the period of rate_hz = {self.rate_hz:g}",
            )
        return self

    @property
    def is_camera(self) -> bool:
        """True for a device of V4L2; False for a file, also one in memory, a pipe or a URL."""
        return self.device.startswith("/dev/") and not self.device.startswith("/dev/shm/")
