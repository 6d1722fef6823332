"""Settings of simulated devices besides a rig's first cameras; cheap to import."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from sliplab.plugins.simulation.scene.optics import Finite, NonNegative, Positive
from sliplab.plugins.simulation.settings import (
    FurtherDevice,
    MockEventCameraSettings,
    MockFrameCameraSettings,
    Seed,
)
from sliplab.protocols.key_errors import KeyedError

if TYPE_CHECKING:
    from sliplab.rigs.stream_settings import FrameStream

Ppm = Annotated[float, Field(ge=0, le=20_000)]


class FurtherEventCamera(MockEventCameraSettings, FurtherDevice):
    """A further event camera in the sensor; it sees the same markers."""

    seed: Seed | None = None
    """Seed of its pixels; left out, the rig's. Cameras of different names differ in any case."""
    clock_ppm: Ppm = 30.0
    """Largest drift of its clock, either way."""


class FurtherFrameCamera(MockFrameCameraSettings, FurtherDevice):
    """A further camera that looks through the plate."""

    seed: Seed | None = None
    clock_ppm: Ppm = 20.0
    """Largest drift of its clock, either way."""

    @property
    def frame_source(self) -> str:
        """Output of the camera: ``video`` or ``tracks``."""
        return self.level

    def stream_faults(self, stream: FrameStream) -> Iterator[KeyedError]:
        """Return what the camera cannot show, and what is worse than its timing states."""
        yield from super().stream_faults(stream)
        for side, px in zip(("width", "height"), stream.region_px, strict=True):
            if px > getattr(self, side):
                text = f"exceeds mock.{side} = {getattr(self, side)}"
                yield KeyedError(".region_px", list(stream.region_px), text)
        if stream.scale_px_per_mm != self.px_per_mm:
            text = f"must be mock.px_per_mm = {self.px_per_mm:g}"
            yield KeyedError(".scale_px_per_mm", stream.scale_px_per_mm, text)
        by_itself = stream.timing.grade != "hardware trigger"  # else the rate has no meaning
        if by_itself and stream.rate_hz is not None and stream.rate_hz != self.rate_hz:
            text = f"must be mock.rate_hz = {self.rate_hz:g}"
            yield KeyedError(".rate_hz", stream.rate_hz, text)


class Thermometer(FurtherDevice):
    """A body that cools to its surroundings by Newton's law, and a digital thermometer on it.

    The trial draws the temperature that the body begins with.
    """

    ambient: Finite = 22.0
    """Temperature of the surroundings, in the stream's unit."""
    above: NonNegative = 2.0
    """The most that the body is warmer when a trial begins."""
    time_constant_s: Positive = 60.0
    noise: NonNegative = 0.02
    """Standard deviation of a reading."""
    resolution: NonNegative = 0.0625
    """Unit to which readings are rounded; 0: none."""
    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 20.0
    latency_us: Annotated[int, Field(ge=0, le=1_000_000)] = 1000
    """From a reading to the host."""
    arrival_jitter_us: Annotated[float, Field(ge=0, le=1_000_000)] = 2000.0
    """Delay besides; half-normal, up to this limit of four sigma."""
