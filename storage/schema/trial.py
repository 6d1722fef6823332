"""The record of a trial, its provenance, and its clocks where they were fitted again.

The record holds all that follows from protocol, seed and versions, and is under the trial's
checksums. Who, when and where are in the provenance, outside of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import (
    AfterValidator,
    Field,
    PlainSerializer,
    PlainValidator,
    WithJsonSchema,
)

from sliplab.protocols.timing import StreamTiming, Timing
from sliplab.storage.clockmap import ClockMap
from sliplab.storage.schema.document import Bool, Document, DocumentError, Int, Number, Part
from sliplab.storage.streams import EVENTS_KIND, FRAMES_KIND, Json

DEVICES = ("events", "frames", "arm")
"""Devices whose clocks have maps onto the time line."""


def _clock_map(value: Any) -> ClockMap:
    if isinstance(value, ClockMap):
        return value
    try:
        return ClockMap.from_json(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"must be a clock map: {error}") from None


_INTEGERS = {"type": "array", "items": {"type": "integer"}}
Map = Annotated[
    ClockMap,
    PlainValidator(_clock_map),
    PlainSerializer(ClockMap.to_json),
    WithJsonSchema(
        {
            "type": "object",
            "properties": dict.fromkeys(("device_ns", "reference_ns", "drift"), _INTEGERS),
            "required": ["device_ns", "reference_ns", "drift"],
            "additionalProperties": False,
        }
    ),
]


def _level(level: str) -> str:
    """A word, or a number with its unit."""
    number, _, unit = level.partition(" ")
    if unit:
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not abs(value) < float("inf"):
            raise ValueError("must be a number with its unit")
    return level


Level = Annotated[str, AfterValidator(_level)]
Point = tuple[Number, Number]
Size = tuple[Int, Int]


class StreamCounts(Part):
    """Rows of each stream."""

    events: Int
    frames: Int
    poses: Int
    pulses: Int


class Gate(Part):
    """One of the protocol's gates, as the trial met it."""

    passed: Bool
    value: Number | str | None
    """The figure, negative where it is unknown; or why there is none, as text."""
    limit: Number | None = None
    grade: str | None = None
    """Of a clock's gate: how the device is timed."""


class TrialQuality(Part):
    """The gates of a trial."""

    passed: Bool
    gates: dict[str, Gate] = Field(default_factory=dict)


class MotionStep(Part):
    """A phase of the motion, on the arm's clock."""

    phase: str
    start_ns: Int
    end_ns: Int
    recorded: Bool = True
    """The streams were recorded in the meantime."""


class DeviceRecord(Part):
    """The clock of one device."""

    map: Map
    """From the device's clock to the time line."""
    uncertainty_ns: Number | None = None
    """Bound of the map's error within the trial; null where unknown."""
    grade: str = "unknown"
    """Method by which the device is timed."""
    kind: str | None = None
    """`95 %` or `hard bound`: the meaning of the uncertainty."""
    drift_ppm: Number | None = None
    drift_error_ppm: Number | None = None
    pairs: Int | None = None
    """Readings of the clock by the host."""
    offset_ns: Int | None = None
    first_ns: Int | None = None
    """First pulse that was paired, on the device's clock."""
    last_ns: Int | None = None
    peak_ratio: Number | None = None
    """Second correlation peak as a share of the first."""
    residual_median_ns: Number | None = None
    residual_p95_ns: Number | None = None
    residual_max_ns: Number | None = None
    pulses_seen: Int | None = None
    """Pulses that the device saw, where it is wired to the sync box."""
    pulses_missed: Int | None = None
    pulses_late: Int | None = None
    pulses_spurious: Int | None = None

    @property
    def wired(self) -> bool:
        """True where the device sees the pulses of the sync box."""
        return self.pulses_seen is not None


class TrialClockMaps(Part):
    """The clocks of one trial: the time line, and the map of each device onto it."""

    reference: str | None = None
    """The clock of the time line."""
    code: str | None = None
    """The train of pulses that the box sent."""
    events: DeviceRecord | None = None
    frames: DeviceRecord | None = None
    arm: DeviceRecord | None = None
    refused: dict[str, str] = Field(default_factory=dict)
    """Reasons why devices have no clock, by device."""
    pieces: dict[str, list[DeviceRecord | str]] = Field(default_factory=dict)
    """Of a device that restarted within the trial: each piece, or why it was not fitted."""
    streams: dict[str, DeviceRecord] = Field(default_factory=dict)
    """Clocks of the named streams; written only where there are any."""

    def devices(self) -> dict[str, DeviceRecord]:
        """The clocks that are known, by device; named streams after the devices."""
        found = ((name, getattr(self, name)) for name in DEVICES)
        return {name: clock for name, clock in found if clock is not None} | self.streams

    def against_events_ns(self, device: str) -> float | None:
        """Return the uncertainty of events against a device, ns; None where it is unknown.

        Of the events themselves it is their own.
        """
        devices = self.devices()
        names = {device, "events"}
        known = [devices[name].uncertainty_ns if name in devices else None for name in names]
        return None if None in known else float(sum(value for value in known if value is not None))


class RecordedTiming(Part):
    """The timing of the rig, from which the clocks are fitted again."""

    rig: Annotated[
        Timing, PlainSerializer(lambda timing: timing.model_dump(mode="json", exclude_none=True))
    ]
    """The section `timing` of the rig file, without the devices that the rig has not."""
    rate_hz: Number
    """Ticks of the sync box a second."""
    mid_exposure_ns: Int | None = None
    """From the start of an exposure to its middle; null without frames."""


class Geometry(Part):
    """Sizes and places of sensors and skin."""

    event_px: Size | None = None
    """Columns and rows of the event camera; null where they are unknown."""
    frame_px: Size | None = None
    """Columns and rows of the frames; null without frames."""
    px_per_mm: Number | None = None
    """Of the frame camera."""
    skin_mm: tuple[Point, ...] = ()
    """Places of the markers at rest."""
    centre: Int = 0
    """Index of the marker in the centre."""
    event_centre_px: Point | None = None
    """Column and row where the event camera sees the skin's centre, if that was calibrated."""


class GivenSpan(Part):
    """Part of a recording that shows one class."""

    start_ns: Int
    end_ns: Int
    name: str
    """The class."""


class Given(Part):
    """Labels that came with a recording, on the trial's time line."""

    source: str
    """Where they stood: a file's name, or `file name`."""
    incipient_ns: Int | None = None
    """Onset of slip; null where the data set has none."""
    gross_ns: Int | None = None
    uncertainty_ns: Number | None = None
    """Bound of the onsets' error; null where unknown."""
    spans: tuple[GivenSpan, ...] = ()
    """Classes other than those of slip."""


class Mark(Part):
    """A moment that a program or a person marked during a recording."""

    name: str
    t_ns: Int
    """On the trial's time line."""
    uncertainty_ns: Number | None = None
    """Bound of its error; null where unknown."""


class Lost(Part):
    """The part of a damaged file that was not read: the trial is what stands whole before it."""

    at_byte: Int
    """Byte of the file at which the damage begins: of the first packet that cannot be read."""
    unread_bytes: Int
    """Bytes of the file that were not read."""
    reason: str
    """The fault, in words."""
    events: Int | None = None
    """Events lost, where the file says how many it should hold."""
    frames: Int | None = None
    """Frames lost, likewise."""


class Imported(Part):
    """Origin of a trial that was not collected here."""

    format: str
    source: str = Field(alias="from")
    """Name of the file."""
    epoch: str | None = None
    """The zero of its times, as text."""
    unknown: tuple[str, ...] = ()
    """Facts about the trial that are no longer known."""
    warnings: tuple[str, ...] = ()
    fields: dict[str, str] = Field(default_factory=dict)
    """What file names and tables said of the trial, by name; written for adapters only."""
    span_ns: tuple[Int, Int] | None = None
    """Start and end of the recording on the time line, where its steps do not say."""
    given: Given | None = None
    """Labels that came with it."""
    marks: tuple[Mark, ...] = ()
    """Marks of a recording, in order of time; written only where there are any."""
    lost: Lost | None = None
    """What is missing, of a trial that was salvaged from a damaged file."""
    dropped: dict[str, Int] = Field(default_factory=dict)
    """Numbers of rows that were left out because they cannot be right, by reason; written only
    where there are any."""


class StreamRecord(Part):
    """A named stream of the trial."""

    kind: str
    """Its kind: `wrench`, `scalar`, and of further cameras `events` or `frames`."""
    rows: Int
    pulses: Int | None = None
    """Of events: sync pulses that the camera saw."""
    size_px: Size | None = None
    """Of events and frames: columns and rows."""
    px_per_mm: Number | None = None
    """Of frames: their scale."""
    rate_hz: Number | None = None
    """Of frames of a camera that runs by itself: frames a second."""
    mid_exposure_ns: Int | None = None
    """Of frames: from the start of an exposure to its middle."""
    unit: str | None = None
    """Of scalars: unit of the readings."""
    timing: (
        Annotated[StreamTiming, PlainSerializer(lambda timing: timing.model_dump(mode="json"))]
        | None
    ) = None
    """How a further device is timed, from which its clock is fitted again; null for the first force
    sensor, which `timing.rig` times."""
    to_plate: tuple[tuple[Number, Number, Number], ...] | None = None
    """Of a wrench: rows of the matrix from its axes to those of the plate (x right, y up, z into
    the plate), such that the product is the force on the plate; null where it is unknown."""
    figures: dict[str, Number] = Field(default_factory=dict)
    """Of forces on the plate: `normal_peak_n`, `normal_hold_n`, `tangential_peak_n` and
    `friction_peak`; of a scalar: `mean`, `min` and `max`; only those that are known."""

    @property
    def of_camera(self) -> bool:
        """True for the stream of a further camera, which has its own files."""
        return self.kind in {EVENTS_KIND, FRAMES_KIND}


class TrialRecord(Document):
    """The record of one attempt at a trial."""

    format: Int = 1
    trial: str
    campaign: str | None = None
    experiment: str
    role: str
    block: Int
    repetition: Int
    attempt: Int
    condition: dict[str, Level]
    """Levels by factor, with their units."""
    context: dict[str, Level] = Field(default_factory=dict)
    """What people had logged by then of skin, temperature and so on, by name; it comes before what
    the condition says of it. Written only where there is any."""
    seed: Annotated[int, Field(strict=True)] | None = None
    rig: str | None = None
    simulated: Bool
    recorded_s: Number
    motion_s: Number | None = None
    """Seconds from the first step to the end of the last."""
    depth_zero_mm: Number | None = None
    """Depth at which the arm found contact, from the rig's plane."""
    depth_zero_sd_mm: Number | None = None
    """Standard deviation of the touches whose mean that is; None of a single touch."""
    counts: StreamCounts
    clocks: TrialClockMaps
    timing: RecordedTiming | None = None
    quality: TrialQuality
    steps: tuple[MotionStep, ...] = ()
    geometry: Geometry = Geometry()
    devices: dict[str, Any] | None = None
    """Settings that the devices reported, by device."""
    simulation_truth: dict[str, Any] | None = None
    """Of a simulated trial: its true onsets and clocks."""
    imported: Imported | None = None
    streams: dict[str, StreamRecord] = Field(default_factory=dict)
    """Named streams besides those counted, by name; written only where there are any."""

    @property
    def lost(self) -> Lost | None:
        """What is missing, of a trial that was salvaged from a damaged file."""
        return None if self.imported is None else self.imported.lost

    @classmethod
    def parse(cls, data: Json, path: Path) -> TrialRecord:
        """Check the record of a trial, committed or not.

        Raises:
            DocumentError, NewerFormat: as `load`.
        """
        found = super().parse(data, path)
        without = found.imported is not None and not found.counts.events
        seen = found.geometry.event_px is not None or (
            found.geometry.frame_px is None and not without
        )
        if found.quality.passed and seen and found.clocks.events is None:
            raise DocumentError(f"{path}: clocks.events: is missing")
        return found


class Provenance(Document):
    """Provenance of a trial: time, place and software of its collection."""

    started: str | None = None
    """UTC, ISO 8601."""
    ended: str | None = None
    host: str | None = None
    system: str | None = None
    python: str | None = None
    versions: dict[str, str] = Field(default_factory=dict)
    operator: str | None = None
    skin: str | None = None
    """Serial number of the skin."""
    disk_free: Int | None = None
    """Bytes."""
    imported: str | None = None
    """Time of the import; UTC, ISO 8601."""
    source: str | None = Field(default=None, alias="from")
    """Name of the file that it was imported from."""


class SyncResult(Document):
    """Result of fitting a trial's clocks again."""

    key: str = ""
    raw: str | None = None
    """Checksum of the raw data that it is of."""
    refused: dict[str, str] = Field(default_factory=dict)
    """Reasons why devices could not be fitted again, by device."""
    clocks: TrialClockMaps | None = None
    """The clocks, where they differ from those of the record."""
