"""A foreign trial before its import: its checked streams and known properties."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.errors import DamagedFile
from sliplab.storage.schema.trial import DeviceRecord, Given, Lost, Step
from sliplab.storage.streams import (
    I64,
    U8,
    EventChunk,
    FrameChunk,
    Json,
    PoseChunk,
    StreamChunk,
)
from sliplab.storage.trials.store import Campaign

RISING = 1
"""A rising edge of the external input, as AEDAT4 numbers triggers."""
EXPORT_MANIFEST, EXPORT_FORMAT = "sliplab-export.json", 1
"""File beside exported trials, from which they are imported again as they were."""
_HEAD_BYTES = 1 << 14
MOST_PX = 1 << 14
LATEST_US = 1 << 53
"""285 years; what comes later is not a time, and would not fit 64 bits of nanoseconds."""


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


@dataclass(frozen=True)
class Seen:
    """First and last time of what was read of a trial, each on its own clock; None without any."""

    events_us: tuple[int, int] | None
    frames_ns: tuple[int, int] | None


@dataclass(frozen=True)
class Whole:
    """What is known of a trial once all of it was read, on the time line.

    Attributes:
        span_ns: begin and end of the recording.
        given: labels that came with it. steps: phases of its motion, on the arm's clock.
    """

    span_ns: tuple[int, int]
    given: Given | None = None
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True)
class ForeignTrial:
    """A trial that can be read.

    Attributes:
        name: its id in the store.
        events: its events in order of time; read again by each call.
        event_px: columns and rows of its camera, None if unknown; called once `events` were read.
        epoch: what the times count from, as text.
        about: further properties in the file, to be kept in the record.
        unknown: names of what nobody knows of it any more.
        kind: name of its format.
        lost: what is damaged in its file, if this is what stands whole before the damage.
        packets: packets that do; None where the format has none.
        poses: of the arm, on its own clock; cameras: frames of further cameras by stream.
        streams: forces and scalars by stream.
        salvage: returns what stands whole in its file, if that turns out to be damaged; raises
            FormatError where that is nothing.
        campaign: the one that it is of; None for one of its own.
        clocks: those that are known, by device and stream. experiment: see the record.
        geometry: further keys of the record's geometry.
        notes: warnings about it, such as of what was left out; called once all was read.
        whole: what follows from all that was read; a trial with it may be without events. Raises
            InputError where that cannot be right.
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
    streams: Mapping[str, StreamChunk] = field(default_factory=dict)
    cameras: Mapping[str, Callable[[], Iterator[FrameChunk]]] = field(default_factory=dict)
    campaign: ForeignCampaign | None = None
    clocks: Mapping[str, DeviceRecord] = field(default_factory=dict)
    experiment: str = "imported"
    geometry: Json = field(default_factory=dict)
    notes: Callable[[], tuple[str, ...]] = tuple
    whole: Callable[[Seen], Whole] | None = None


def refusal(file: Path, error: FormatError) -> InputError:
    """Return the error of a file that is not imported: bad data, or else wrong input."""
    kind = DamagedFile if isinstance(error, Damage) else InputError
    return kind(file, error.key, None, str(error))


def before_damage(
    read: Callable[[], ForeignTrial], error: FormatError, salvage: bool
) -> ForeignTrial:
    """Return what stands whole in a file that could not be read.

    Args:
        error: the fault that was found.

    Raises:
        Damage: that is nothing, or it is not to be salvaged, and only offered.
        FormatError: the fault is no damage.
    """
    try:
        whole = read()
        if whole.lost is None:
            raise error
        if salvage:
            return whole
        count, last_us = 0, None
        for chunk in whole.events():
            count += len(chunk)
            last_us = int(chunk.t_us[-1]) if len(chunk) else last_us
    except FormatError as fault:
        if fault is error:
            raise
        worse = fault if isinstance(fault, Damage) else error
        raise Damage(str(worse), error.file) from None
    if last_us is None:
        raise Damage(f"{error}; no event stands before that", error.file)
    packets = "" if whole.packets is None else f", in {whole.packets:,} whole packets"
    offer = f"--salvage imports {count:,} events up to {last_us} us{packets}"
    raise Damage(f"{error}; {offer}", error.file)


def event_chunk(x: Any, y: Any, p: Any, t_us: Any) -> EventChunk:
    """Check columns of a foreign file and return them as a chunk.

    Raises:
        FormatError: they differ in length, a pixel or time is none, or times decrease.
    """
    columns = [np.asarray(column) for column in (x, y, p, t_us)]
    if any(c.ndim != 1 or len(c) != len(columns[3]) for c in columns):
        raise FormatError("contains event columns of different lengths")
    if any(c.dtype.kind not in "iub" for c in columns):
        raise FormatError("contains event values that are not integers")
    times = np.ascontiguousarray(columns[3], np.int64)
    ends = times[[0, -1]] if len(times) else times
    limits = (("column", MOST_PX), ("row", MOST_PX), ("polarity", 2), ("time", LATEST_US))
    for column, (what, most) in zip([*columns[:3], ends], limits, strict=True):
        if not len(column) or column.dtype.kind == "b":
            continue
        negative = column.dtype.kind == "i" and int(column.min()) < 0
        if negative or int(column.max()) >= most:
            raise FormatError(f"holds an event whose {what} is {column.min()} or {column.max()}")
    if np.any(times[1:] < times[:-1]):
        raise FormatError("contains events with decreasing times")
    return EventChunk(
        np.ascontiguousarray(columns[0], np.uint16),
        np.ascontiguousarray(columns[1], np.uint16),
        np.ascontiguousarray(columns[2], np.uint8),
        times,
    )


def check_pixels(chunk: EventChunk, size: tuple[int, int] | None) -> None:
    """Check events against the size that their file gives its camera.

    Raises:
        FormatError: one lies outside.
    """
    if size is None or not len(chunk):
        return
    x, y = int(chunk.x.max()), int(chunk.y.max())
    if x >= size[0] or y >= size[1]:
        raise FormatError(
            f"holds events up to column {x} and row {y}, outside of the {size[0]} x {size[1]} "
            "pixels that it gives its camera"
        )


def grey(levels: U8) -> U8:
    """Return a picture's grey levels (ITU-R BT.601), as an array of its own.

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

    Args:
        per_unit: microseconds of one unit.

    Raises:
        FormatError: one is not a number, or beyond any time.
    """
    with np.errstate(over="ignore", invalid="ignore"):  # what is beyond any number is found below
        found = np.asarray(times, np.float64) * per_unit
    if len(found) and not (np.isfinite(found).all() and float(np.abs(found).max()) < LATEST_US):
        raise FormatError("contains a time that is not a number or is out of range")
    return np.rint(found).astype(np.int64)
