"""A foreign trial before its import: its checked streams and known properties."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.schema.trial import DeviceRecord, Given, Lost, MotionStep, StreamCounts
from sliplab.storage.streams import (
    I64,
    U8,
    Chunk,
    EventChunk,
    FrameChunk,
    Json,
    PoseChunk,
    ScalarChunk,
    WrenchChunk,
)
from sliplab.storage.trials.store import Campaign, TrialStore

OUTSIDE = "events outside of the sensor"
UNKNOWN_POLARITY = "events with an unknown polarity"
NO_TIME = "{} without a valid time"
NEGATIVE = "events with a negative time"
"""Reasons why rows are left out, by their kind."""
NO_TIME_NS = -(1 << 63)
"""In place of a time that is not a number or is out of range."""
ChunkT = TypeVar("ChunkT", bound=EventChunk | FrameChunk | PoseChunk | WrenchChunk | ScalarChunk)
RISING = 1
"""A rising edge of the external input, as AEDAT4 numbers triggers."""
EXPORT_MANIFEST, EXPORT_FORMAT = "sliplab-export.json", 1
EXPORT_UNFINISHED = "unfinished"
"""Key of the manifest: files that an export may have written that has not ended."""
"""File next to exported trials, from which they are imported again unchanged."""
_HEAD_BYTES = 1 << 14
MOST_PX = 1 << 14
"""Columns or rows of a camera that are read."""
TOO_FAR = f"events at a column or row above {MOST_PX - 1:,}"
LATEST_US = 1 << 53
"""285 years; a larger value is not a time, and would not fit 64 bits of nanoseconds."""


class FormatError(ValueError):
    """A foreign file cannot be right.

    Attributes:
        file: the file, where a trial has several.
        key: of an adapter, which says how the file is read; empty without one.
    """

    def __init__(self, message: str, file: Path | None = None) -> None:
        """Make one whose `message` continues after the file's name, such as "is truncated"."""
        self.file = file
        self.key = ""
        super().__init__(message)


class LabelError(InputError):
    """A label that came with a recording does not fit it."""


class Damage(FormatError):
    """A recording is truncated, or damaged behind its header."""


class NoEvents(FormatError):
    """A recording is whole and contains no events."""


@contextmanager
def as_damage() -> Iterator[None]:
    """Report a fault in the content of a recording, whose header is read already, as damage."""
    try:
        yield
    except FormatError as error:
        raise error if isinstance(error, Damage) else Damage(str(error), error.file) from None


def read_head(path: Path) -> bytes:
    """Return the first 16 KiB of a file.

    Raises:
        InputError: it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(_HEAD_BYTES)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None


@dataclass(frozen=True)
class ForeignChunk(EventChunk):
    """Events of a foreign file, whose times may be out of order.

    Attributes:
        left_out: numbers of events that cannot be right and are left out, by reason.
        resolution_us: spacing of its floating-point times at the last one, us; 0 for integers.
    """

    left_out: Mapping[str, int] = field(default_factory=dict)
    resolution_us: float = 0.0


@dataclass(frozen=True)
class Skipped:
    """A part of a folder that is not imported."""

    file: str
    reason: str


@dataclass(frozen=True)
class Triggers:
    """Triggers of the event camera as the file has them, shape (n,)."""

    t_us: I64
    kind: U8
    """Kinds as AEDAT4 numbers them; 1 is a rising edge of the external input."""


class ForeignCampaign(Protocol):
    """The campaign that foreign trials are of."""

    def join(self, campaign: Campaign, source: str) -> None:
        """Describe a new campaign of a store, or check that the one there is this one.

        Args:
            source: of the trial that joins, for messages.

        Raises:
            InputError: it is another one.
        """


class Restorable(Protocol):
    """A trial of a store that can be committed to another store as it was."""

    def restore(
        self, store: TrialStore, campaign: Campaign, name: str, about: Json
    ) -> StreamCounts:
        """Commit the trial with its label and clocks.

        Args:
            about: what its provenance keeps of the import.

        Returns:
            Rows of its streams.

        Raises:
            FormatError: it is damaged.
        """


@dataclass(frozen=True)
class DataSpan:
    """First and last time of a trial's data, each on its own clock; None without any.

    Attributes:
        further_ns: of poses and streams by name.
    """

    events_us: tuple[int, int] | None
    frames_ns: tuple[int, int] | None
    further_ns: Mapping[str, tuple[int, int]] = field(default_factory=dict)


@dataclass(frozen=True)
class Whole:
    """Properties of a trial that are known once all of it was read, on the time line.

    Attributes:
        span_ns: begin and end of the recording.
        given: labels that came with it. steps: phases of its motion, on the arm's clock.
    """

    span_ns: tuple[int, int]
    given: Given | None = None
    steps: tuple[MotionStep, ...] = ()


@dataclass(frozen=True)
class ForeignTrial:
    """A trial that can be read.

    Attributes:
        name: its id in the store.
        events: its events as the file lists them; read again by each call.
        any_order: the file may list them in another order than that of their times.
        event_px: columns and rows of its camera, None if unknown; called once `events` were read.
        epoch: what the times count from, as text.
        about: further properties in the file, to be stored in the record.
        unknown: names of missing metadata.
        kind: name of its format.
        lost: the damage of its file, if this is the intact part before the damage.
        packets: number of intact packets; None where the format has none.
        poses: of the arm, on its own clock; cameras: frames of further cameras by stream.
        streams: forces and scalars by stream.
        left_out: rows that were left out while it was opened, by reason.
        resolution_us: of the type of the times of frames and streams, us, by stream.
        notes: warnings about it, such as of files that contradict each other; called once all was
            read.
        salvage: returns the intact part of its file, if that turns out to be damaged; raises
            FormatError if there is none.
        campaign: the campaign that it belongs to; None for a separate one.
        original: a trial of a store with all that belongs to it; it is committed as it was.
        clocks: those that are known, by device and stream. experiment: see the record.
        geometry: further keys of the record's geometry.
        whole: what follows from all that was read; a trial with it may be without events. Raises
            InputError where that cannot be right.
        error: fault because of which it cannot be read at all.
    """

    name: str
    source: str
    events: Callable[[], Iterator[EventChunk]]
    epoch: str
    event_px: Callable[[], tuple[int, int] | None] = lambda: None
    triggers: Triggers | None = None
    frames: Callable[[], Iterator[FrameChunk]] | None = None
    frame_px: tuple[int, int] | None = None
    condition: dict[str, str] = field(default_factory=dict)
    repetition: int = 0
    simulated: bool = False
    about: Json = field(default_factory=dict)
    unknown: tuple[str, ...] = ()
    kind: str = ""
    lost: Lost | None = None
    packets: int | None = None
    salvage: Callable[[], ForeignTrial] | None = None
    poses: PoseChunk | None = None
    streams: Mapping[str, Chunk] = field(default_factory=dict)
    left_out: Mapping[str, int] = field(default_factory=dict)
    resolution_us: Mapping[str, float] = field(default_factory=dict)
    notes: Callable[[], tuple[str, ...]] = tuple
    cameras: Mapping[str, Callable[[], Iterator[FrameChunk]]] = field(default_factory=dict)
    campaign: ForeignCampaign | None = None
    original: Restorable | None = None
    clocks: Mapping[str, DeviceRecord] = field(default_factory=dict)
    experiment: str = "imported"
    geometry: Json = field(default_factory=dict)
    whole: Callable[[DataSpan], Whole] | None = None
    error: FormatError | InputError | None = None
    any_order: bool = False


def broken(name: str, source: str, error: FormatError | InputError) -> ForeignTrial:
    """Return a trial that cannot be read: the import reports `error`, and continues."""
    return ForeignTrial(name, source, lambda: iter(()), "unknown", error=error)


def refusal(file: Path, error: FormatError) -> InputError:
    """Return the error of a file that is not imported: bad data, or else wrong input."""
    kind = DamagedFile if isinstance(error, Damage) else InputError
    return kind(file, error.key, None, str(error))


_PIXEL = ((OUTSIDE, 0, 1 << 64), (TOO_FAR, 0, MOST_PX))
_RANGES: tuple[tuple[tuple[str, int, int], ...], ...] = (
    _PIXEL,
    _PIXEL,
    ((UNKNOWN_POLARITY, 0, 2),),
    ((NO_TIME.format("events"), -LATEST_US, LATEST_US), (NEGATIVE, 0, LATEST_US)),
)
"""Why x, y, polarity or time of an event cannot be right outside of a range, from a value up to
below another; the last range of each lies in those before."""


def check_size(what: str, size: tuple[int, int]) -> None:
    """Check columns and rows of a camera. Raises FormatError.

    Args:
        what: has this size, such as "states a sensor".
    """
    if max(size) > MOST_PX:
        raise FormatError(
            f"{what} of {size[0]} x {size[1]} pixels; read are up to {MOST_PX:,} columns and rows"
        )


def event_chunk(x: Any, y: Any, p: Any, t_us: Any, resolution_us: float = 0.0) -> ForeignChunk:
    """Return columns of a foreign file as a chunk, without the events that cannot be right.

    Those have a pixel, polarity or time that no camera has; polarities of -1 are OFF.

    Args:
        resolution_us: of the type of the times, us.

    Raises:
        FormatError: the columns differ in length, or are not integers.
    """
    columns = [np.asarray(column) for column in (x, y, p, t_us)]
    if any(c.ndim != 1 or len(c) != len(columns[3]) for c in columns):
        raise FormatError("contains event columns of different lengths")
    if any(c.dtype.kind not in "iub" for c in columns):
        raise FormatError("contains event values that are not integers")
    if columns[2].dtype.kind == "i" and len(columns[2]) and columns[2].min() == -1:
        columns[2] = np.where(columns[2] == -1, 0, columns[2])
    good, left_out = None, Counter[str]()
    for column, ranges in zip(columns, _RANGES, strict=True):
        if not len(column) or column.dtype.kind == "b":
            continue
        if column.min() >= 0 and column.max() < ranges[-1][2]:
            continue
        for reason, least, most in ranges:
            right = (column >= least) & (column < most)
            right = right if good is None else right & good
            wrong = (len(right) if good is None else int(good.sum())) - int(right.sum())
            if wrong:
                left_out[reason] += wrong
            good = right
    if good is not None:
        columns = [column[good] for column in columns]
    return ForeignChunk(
        np.ascontiguousarray(columns[0], np.uint16),
        np.ascontiguousarray(columns[1], np.uint16),
        np.ascontiguousarray(columns[2], np.uint8),
        np.ascontiguousarray(columns[3], np.int64),
        left_out,
        resolution_us,
    )


def empty_events(count: int) -> EventChunk:
    """Return a chunk with room for some events."""
    return EventChunk(
        np.empty(count, np.uint16),
        np.empty(count, np.uint16),
        np.empty(count, np.uint8),
        np.empty(count, np.int64),
    )


def inside(chunk: EventChunk, size: tuple[int, int] | None) -> EventChunk:
    """Return a chunk without the events outside of the size that their file gives its camera."""
    if size is None or not len(chunk):
        return chunk
    if int(chunk.x.max()) < size[0] and int(chunk.y.max()) < size[1]:
        return chunk
    good = (chunk.x < size[0]) & (chunk.y < size[1])
    left_out = Counter(left_out_of(chunk))
    left_out[OUTSIDE] += len(good) - int(good.sum())
    resolution = chunk.resolution_us if isinstance(chunk, ForeignChunk) else 0.0
    part = chunk[good]
    return ForeignChunk(part.x, part.y, part.p, part.t_us, left_out, resolution)


def left_out_of(chunk: EventChunk) -> Mapping[str, int]:
    """Return the numbers of events that were left out of a chunk, by reason."""
    return chunk.left_out if isinstance(chunk, ForeignChunk) else {}


def resolution_us(times: Any, per_unit: float, whole_us: float = 0.0) -> float:
    """Return the resolution of the times' type at the latest time, us.

    Args:
        per_unit: microseconds of one unit of the times.
        whole_us: what integers count as: slow readings may be stamped with whole seconds.
    """
    found = np.asarray(times)
    if found.dtype.kind != "f":
        return whole_us
    finite = np.abs(found[np.isfinite(found)])
    return float(np.spacing(finite.max())) * per_unit if len(finite) else 0.0


def grey(levels: U8) -> U8:
    """Return a picture's grey levels (ITU-R BT.601), as a new array.

    Args:
        levels: shape (height, width), or with a last axis of grey, or of blue, green, red and
            perhaps opacity, as OpenCV orders them.
    """
    if levels.ndim == 2 or levels.shape[2] == 1:
        return np.array(levels, np.uint8).reshape(levels.shape[:2])
    weighed = levels[..., :3].astype(np.uint32) @ np.array([114, 587, 299], np.uint32) + 500
    return np.asarray(weighed // 1000, np.uint8)


def rounded_us(times: Any, per_unit: float) -> I64:
    """Round times in another unit to whole microseconds.

    What is not a number, or beyond any time, becomes `NO_TIME_NS`, which `event_chunk` leaves out.

    Args:
        per_unit: microseconds of one unit.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond any number is found below
        found = np.asarray(times, np.float64) * per_unit
        good = np.abs(found) < LATEST_US
    return np.where(good, np.rint(np.where(good, found, 0.0)), NO_TIME_NS).astype(np.int64)
