"""Chunks of device streams, and the kinds of stream: plain arrays with raw device times.

A chunk is the unit that flows from a device through the rig into the recording being written.
Nothing here converts a time: raw device times are stored unchanged, and clock maps are added
later (docs/decisions/time.md). All times are int64.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, make_dataclass, replace
from functools import cache
from typing import Any, ClassVar, NamedTuple, Protocol, Self, runtime_checkable

import numpy as np
import numpy.typing as npt

I64 = npt.NDArray[np.int64]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]


NUMBERS = frozenset(np.dtype(letter).name for letter in "?bBhHiIqQefd")
"""Types of columns: truth values, integers and floats of up to 64 bits."""
MOST_RANK, MOST_COLUMNS = 4, 512
STREAM_NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
"""Names of streams, of their kinds and of columns."""


class Column(NamedTuple):
    """A column of a stored stream."""

    field: str
    """The field of the stream's chunks."""
    dtype: str
    """One of `NUMBERS`, by any of numpy's names."""
    shape: tuple[int, ...]
    """Of one row, `MOST_RANK` at most; -1 for a length that the first row decides."""
    unit: str


@dataclass(frozen=True)
class StreamKind:
    """A kind of stream. A package adds one: a constant, and a subclass of `Chunk` that has it.

    Attributes:
        name: as it is stored.
        columns: by their stored names; ``t`` has the time of each row, and ``host``, if it is
            there, the host's time of reception.
        indexed: rows are found by their time, through an index.
        camera: ``events`` or ``frames``, the first camera in whose groups it is, where a camera
            sends it: a further camera has a file with the same groups.

    Raises:
        ValueError: it could not be stored: a name, no ``t``, or what a column's rows are.
    """

    name: str
    columns: Mapping[str, Column]
    indexed: bool = False
    camera: str = ""

    def __post_init__(self) -> None:
        """Check the columns."""
        for name in (self.name, *self.columns):
            if not STREAM_NAME.fullmatch(name):
                text = f"name {name!r} must match {STREAM_NAME.pattern}"
                raise ValueError(f"stream kind {self.name}: {text}")
        if "t" not in self.columns:
            raise ValueError(f"stream kind {self.name}: has no column t, the time of each row")
        if len(self.columns) > MOST_COLUMNS:
            raise ValueError(f"stream kind {self.name}: has more than {MOST_COLUMNS} columns")
        for name, column in self.columns.items():
            known = {"int64"} if name in {"t", "host"} else NUMBERS
            if np.dtype(column.dtype).name not in known or len(column.shape) > MOST_RANK:
                text = f"must be of {', '.join(sorted(known))}, with {MOST_RANK} axes a row at most"
                found = f"{column.dtype}, {column.shape}"
                raise ValueError(f"stream kind {self.name}: column {name} = {found}: {text}")

    def timed_by(self, unit: str) -> StreamKind:
        """Return the same kind with another unit of its times."""
        times = self.columns["t"]._replace(unit=unit)
        return replace(self, columns={**self.columns, "t": times})


_HOST = Column("host_ns", "int64", (), "ns of the host's monotonic clock")
EVENTS = StreamKind(
    "events",
    {
        "x": Column("x", "uint16", (), "px"),
        "y": Column("y", "uint16", (), "px"),
        "p": Column("p", "uint8", (), "1 brighter, 0 darker"),
        "t": Column("t_us", "int64", (), "us of the event camera's clock after t_offset"),
    },
    indexed=True,
    camera="events",
)
FRAMES = StreamKind(
    "frames",
    {
        "number": Column("number", "int64", (), "the camera's frame counter"),
        "t": Column("t_ns", "int64", (), "ns of the frame camera's clock, middle of exposure"),
        "host": _HOST,
        "sync": Column("sync", "uint8", (), "level of the sync line during exposure"),
    },
    camera="frames",
)
POSES = StreamKind(
    "poses",
    {
        "t": Column("t_ns", "int64", (), "ns of the arm controller's clock"),
        "host": _HOST,
        "xyz": Column("xyz_mm", "float64", (3,), "mm in the arm's base frame"),
        "rotvec": Column("rotvec_deg", "float64", (3,), "degrees, rotation vector"),
    },
)
PULSES = StreamKind(
    "pulses", {"t": Column("t_ns", "int64", (), "ns of the device's clock")}, camera="events"
)
EXPOSURES = replace(PULSES, name="exposures")
READS = StreamKind(
    "reads",
    {
        "t": Column("device_ns", "int64", (), "ns of the device's clock"),
        "before": Column("before_ns", "int64", (), "ns of the host's monotonic clock"),
        "after": Column("after_ns", "int64", (), "ns of the host's monotonic clock"),
    },
    camera="frames",
)
_ERROR = Column("error_ns", "int64", (), "ns, bound of what else the reading may be off")
CLOCK = StreamKind("clock", {**READS.columns, "error": _ERROR})
"""Readings of a recorded stream's clock; it may fall back."""
TRIGGERS = StreamKind(
    "triggers",
    {
        "t": Column("t_ns", "int64", (), "ns of the event camera's clock"),
        "kind": Column("kind", "uint8", (), "what the event camera noted, as AEDAT4 numbers it"),
    },
    camera="events",
)
WRENCH = StreamKind(
    "wrench",
    {
        "t": Column("t_ns", "int64", (), "ns of the sensor's clock"),
        "host": _HOST,
        "force": Column("force_n", "float64", (3,), "N along the sensor's axes"),
        "torque": Column("torque_nm", "float64", (3,), "N m about the sensor's axes"),
    },
)
SCALAR = StreamKind(
    "scalar",
    {
        "t": Column("t_ns", "int64", (), "ns of the sensor's clock"),
        "host": _HOST,
        "value": Column("value", "float64", (), "the group's attribute `unit`"),
    },
)


class Chunk:
    """n rows of one stream in order; the first axis of each of its arrays counts the rows."""

    KIND: ClassVar[StreamKind]

    def __len__(self) -> int:
        return len(self.times)

    @property
    def times(self) -> I64:
        """The time of each row on the device's clock, in the unit that the kind says."""
        times: I64 = getattr(self, self.KIND.columns["t"].field)
        return times

    def __getitem__(self, part: slice | npt.NDArray[Any]) -> Self:
        """Return the rows of a slice, a mask, or an array of indices."""
        return self._with({name: values[part] for name, values in self._arrays().items()})

    def _arrays(self) -> dict[str, npt.NDArray[Any]]:
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}

    def _with(self, arrays: Mapping[str, npt.NDArray[Any]]) -> Self:
        return type(self)(**{**vars(self), **arrays})

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """Return chunks that follow each other in time as one; a single one is not copied."""
        if len(parts) < 2:
            return parts[0] if parts else cls.empty()
        names = parts[0]._arrays()
        return parts[0]._with({n: np.concatenate([getattr(p, n) for p in parts]) for n in names})

    joined = concatenate
    """The former name, which drivers of other packages use."""

    @classmethod
    def from_columns(cls, columns: Mapping[str, npt.NDArray[Any]], **more: Any) -> Self:
        """Return a chunk of columns by their stored names.

        Args:
            more: fields of the chunk that are no columns.
        """
        known = cls.KIND.columns
        return cls(**{known[part].field: values for part, values in columns.items()}, **more)

    @classmethod
    def empty(cls) -> Self:
        """Return a chunk without rows."""
        columns = cls.KIND.columns
        return cls.from_columns({k: np.empty((0, *c.shape), c.dtype) for k, c in columns.items()})


def chunk_type(kind: StreamKind) -> type[Chunk]:
    """Return the type of a kind's chunks, with an array for each column."""
    return _chunk_type(kind.name, tuple(kind.columns.items()))


@cache
def _chunk_type(name: str, columns: tuple[tuple[str, Column], ...]) -> type[Chunk]:
    kind = StreamKind(name, dict(columns))
    fields = [(column.field, np.ndarray) for _, column in columns]
    made: type[Chunk] = make_dataclass(
        "TableChunk", fields, bases=(Chunk,), namespace={"KIND": kind}, frozen=True
    )
    return made


@dataclass(frozen=True)
class EventChunk(Chunk):
    """Events in time order, each array of shape (n,)."""

    KIND = EVENTS

    x: U16
    """Column, pixels from the left."""
    y: U16
    """Row, pixels from the top."""
    p: U8
    """Polarity: 1 brighter, 0 darker."""
    t_us: I64
    """Camera clock, microseconds, never decreasing."""


@dataclass(frozen=True)
class PulseChunk(Chunk):
    """Rising edges as one device saw them, of the sync line or of another one, shape (n,)."""

    KIND = PULSES

    t_ns: I64
    """Clock of that device, nanoseconds (a microsecond counter times 1,000)."""


@dataclass(frozen=True)
class ExposureChunk(PulseChunk):
    """Starts of a frame camera's exposures, as the sync box saw them, shape (n,)."""

    KIND = EXPOSURES


@dataclass(frozen=True)
class TriggerChunk(Chunk):
    """Triggers that an event camera noted, of an imported trial, shape (n,)."""

    KIND = TRIGGERS

    t_ns: I64
    """Clock of the camera, nanoseconds."""
    kind: U8
    """What it noted, as AEDAT4 numbers it."""


@dataclass(frozen=True)
class ClockReads(Chunk):
    """A device's clock, read by the host between a question and its answer, n times."""

    KIND = READS

    device_ns: I64
    """Reading of the device's clock, nanoseconds, shape (n,)."""
    before_ns: I64
    """Host's monotonic clock when it asked, nanoseconds, shape (n,)."""
    after_ns: I64
    """Host's monotonic clock when it had the answer, nanoseconds, shape (n,)."""


@dataclass(frozen=True)
class PoseChunk(Chunk):
    """Arm poses as the controller reported them, n of them."""

    KIND = POSES

    t_ns: I64
    """Controller clock, nanoseconds, shape (n,)."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    xyz_mm: F64
    """Tool centre point in the arm's base frame, mm, shape (n, 3)."""
    rotvec_deg: F64
    """Rotation vector, degrees, shape (n, 3)."""


@dataclass(frozen=True)
class FrameChunk(Chunk):
    """Frames of the outside camera in order, n of them: images, or the marker positions in them."""

    KIND = FRAMES

    images: U8
    """Grey levels, shape (n, height, width); (n, 0, 0) from a camera that returns tracks."""
    number: I64
    """The camera's own frame counter, shape (n,); a gap is a lost frame."""
    t_ns: I64
    """Middle of exposure on the camera's clock, nanoseconds, shape (n,); equals `host_ns` for a
    camera without a readable clock."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    sync: U8
    """Level of the sync line during the exposure: 0 or 1, shape (n,); 0 where none is wired."""
    markers_px: F32 | None = None
    """Instead of images: column and row of every papilla's marker in the order of the skin's
    layout, shape (n, m, 2), NaN where it was not seen whole."""
    plate_px: F32 | None = None
    """Centre of the plate's marker, with `markers_px`, shape (n, 2); None without one."""

    @classmethod
    def empty(cls) -> Self:
        """Return a chunk without frames."""
        none = np.empty(0, np.int64)
        images = np.empty((0, 0, 0), np.uint8)
        return cls(images, none, none, none, none.astype(np.uint8))


@dataclass(frozen=True)
class WrenchChunk(Chunk):
    """Forces and torques of one sensor in its own axes, n of them."""

    KIND = WRENCH

    t_ns: I64
    """Sensor's clock, nanoseconds, shape (n,)."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    force_n: F64
    """Force along the sensor's axes, newtons, shape (n, 3)."""
    torque_nm: F64
    """Torque about the sensor's axes, newton metres, shape (n, 3)."""


@dataclass(frozen=True)
class ScalarChunk(Chunk):
    """Readings of one quantity, such as a temperature, n of them."""

    KIND = SCALAR

    t_ns: I64
    """Sensor's clock, nanoseconds, shape (n,); `host_ns` again from a sensor without a clock."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    value: F64
    """Readings in `unit`, shape (n,)."""
    unit: str = ""
    """Unit of the readings, such as ``degC``; the same over a whole stream."""

    @classmethod
    def empty(cls, unit: str = "") -> Self:
        """Return a chunk without readings."""
        return replace(super().empty(), unit=unit)


CHUNKS: dict[str, type[Chunk]] = {
    chunk.KIND.name: chunk
    for chunk in (
        EventChunk,
        FrameChunk,
        PoseChunk,
        PulseChunk,
        ExposureChunk,
        ClockReads,
        TriggerChunk,
        WrenchChunk,
        ScalarChunk,
    )
}
"""Types of the chunks of SlipLab's own kinds of stream, by the kind's name."""
EVENTS_KIND, FRAMES_KIND = EVENTS.name, FRAMES.name
"""Names of the first cameras' streams, and of the kinds of further cameras' ones."""


@dataclass(frozen=True)
class StepTimes:
    """Start and end of one step of the motion program, on the arm's controller clock."""

    index: int
    phase: str
    start_ns: int
    end_ns: int


@dataclass(frozen=True)
class PathSegment:
    """A straight segment that the arm was commanded to move along, or a position to hold."""

    start_ns: int
    end_ns: int
    """On the arm's clock."""
    begin_mm: tuple[float, float, float]
    end_mm: tuple[float, float, float]
    """Tool centre point in the arm's base frame."""
    speed_mm_s: float = 0.0
    """Along the segment; 0 for a position to hold."""


@runtime_checkable
class Sink(Protocol):
    """Receiver of a rig's streams; a trial being written is one."""

    def add(self, device: str, chunk: Chunk) -> None:
        """Append to the stream of a device that is of the chunk's kind, in time order.

        Args:
            device: ``arm``, ``sync_box``, ``events`` and ``frames`` (the first cameras), or the
                name of any other device that the rig has.
        """


class NullSink:
    """A sink that drops every chunk; a subclass takes some of them."""

    def add(self, device: str, chunk: Chunk) -> None:
        """Drop a chunk."""


Json = dict[str, Any]
