"""Settings of the simulated cameras' optics and pixels; cheap to import, for rig files.

Names carry the unit. The defaults are plausible assumed values.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field

from sliplab.protocols.key_errors import KeyedError
from sliplab.protocols.yaml_file import StrictModel, rule

Positive = Annotated[float, Field(gt=0, le=1e9)]
NonNegative = Annotated[float, Field(ge=0, le=1e9)]
Finite = Annotated[float, Field(ge=-1e9, le=1e9)]


class EventOptics(StrictModel):
    """An event camera, and the markers that it sees."""

    width: Annotated[int, Field(ge=64, le=4096)] = 640
    height: Annotated[int, Field(ge=64, le=4096)] = 480
    px_per_mm: Positive = 14.0
    shift_mm_per_n: Finite = 4.5
    """Motion of a marker in the image per tangential force, in mm of the skin."""
    growth_mm_per_n: Finite = 0.4
    """Growth of a marker's radius with normal force."""
    radius_mm: Positive = 1.2
    edge_px: Positive = 0.8
    """Scale of the logistic edge; the profile is truncated at five scales."""
    contrast: Positive = 2.08
    """Log intensity of a marker relative to its surroundings."""
    threshold: Positive = 0.2
    threshold_sigma: NonNegative = 0.03
    """Standard deviation between pixels, clipped at three sigma."""
    threshold_off: Positive | None = None
    """Mean threshold of negative events; null: as `threshold`. With this or the next setting,
    negative thresholds are drawn independently; without, a pixel has one for both polarities."""
    threshold_off_sigma: NonNegative | None = None
    """Standard deviation of negative thresholds; null: as `threshold_sigma`."""
    cutoff_hz: Annotated[float, Field(ge=0, le=1e6)] = 0.0
    """Bandwidth (3 dB) of a pixel at full brightness, proportional to intensity elsewhere; 0: no
    limit."""
    refractory_us: NonNegative = 500.0
    noise_hz: Annotated[float, Field(ge=0, le=100)] = 0.01
    """Noise events per second of a dark pixel."""
    leak: Literal["events", "reference"] = "events"
    """Effect of leakage: positive events at random times, or a steadily falling reference level,
    which advances positive events and delays negative ones, as in v2e."""
    leak_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Share of the noise that is leakage (positive, at any brightness); the rest is shot noise of
    both polarities, which the brightest pixels have a quarter of."""
    hot_pixels: Annotated[int, Field(ge=0, le=4096)] = 8
    """Number of hot pixels, selected by the rig's seed."""
    hot_hz: Annotated[float, Field(ge=0, le=1000)] = 10.0
    """Mean event rate of a hot pixel; its events are positive."""
    readout_hz: Annotated[float, Field(ge=0, le=10_000)] = 5000.0
    """Read-out scans per second: an event is read in the next scan, at most one per pixel and scan.
    At least 1000; 0: every event has its own time."""
    scan_us: Annotated[float, Field(ge=0, le=1000)] = 192.0
    """Time in which a scan reads its columns from left to right; an event has the read time of its
    column. Limited to the scan period; 0: all events of a scan have its start time."""
    block_ms: Literal[1, 2, 4, 8, 16, 32, 64] = 32
    """Duration of the blocks that the camera sends, which is its latency."""
    path: Literal["cubic", "chord"] = "cubic"
    """Interpolation of markers between two steps of the contact: smooth, or straight."""

    @rule
    def _scans(self) -> Self:
        if 0 < self.readout_hz < 1000:
            raise KeyedError(
                ".readout_hz",
                self.readout_hz,
                "must be 0 (no scans), or 1000 to 10000 scans per second",
            )
        return self

    @property
    def block_ns(self) -> int:
        """Length of a block: what the camera delivers together."""
        return self.block_ms * 1_000_000

    @property
    def period_ns(self) -> int:
        """Time between two scans of the read-out; 0 where every event has its own time."""
        return round(1e9 / self.readout_hz) if self.readout_hz > 0 else 0

    @property
    def has_circuit(self) -> bool:
        """Check if pixels have more than one threshold and a memory."""
        off = self.threshold_off is not None or self.threshold_off_sigma is not None
        return off or self.cutoff_hz > 0 or self.leak == "reference"

    @property
    def column_ns(self) -> float:
        """Time from one column to the next in a scan; a scan is read before the next one begins."""
        return min(self.scan_us * 1e3, self.period_ns) / self.width


class Reflections(StrictModel):
    """Static reflections in the acrylic, which disturb the labels.

    At the default level onsets shift by a few milliseconds. Above about 40 (a quarter of the
    contrast) the tracker mistakes reflections for markers, and labels are meaningless.
    """

    count: Annotated[int, Field(ge=0, le=100)] = 0
    """Number of soft blobs and streaks per trial, placed by its seed; 0 for none."""
    level: Annotated[float, Field(ge=0, le=255)] = 10.0
    """Largest added grey level."""
    size_mm: Positive = 3.0
    """Approximate standard deviation along each of them."""
