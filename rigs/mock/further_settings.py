"""Settings of simulated devices besides a rig's first cameras; cheap to import."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from sliplab.protocols.yaml_file import StrictModel
from sliplab.rigs.mock.settings import (
    Finite,
    MockEventCameraSettings,
    MockForceSensorSettings,
    MockFrameCameraSettings,
    NonNegative,
    Positive,
    Seed,
)

Ppm = Annotated[float, Field(ge=0, le=20_000)]


class FurtherEventCamera(MockEventCameraSettings):
    """A further event camera in the sensor; it sees the same markers."""

    seed: Seed | None = None
    """Seed of its pixels; left out, the rig's. Cameras of different names differ in any case."""
    clock_ppm: Ppm = 30.0
    """Largest drift of its clock, either way."""


class FurtherFrameCamera(MockFrameCameraSettings):
    """A further camera that looks through the plate."""

    seed: Seed | None = None
    clock_ppm: Ppm = 20.0
    """Largest drift of its clock, either way."""


class Thermometer(StrictModel):
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


Further = FurtherEventCamera | FurtherFrameCamera | MockForceSensorSettings | Thermometer
