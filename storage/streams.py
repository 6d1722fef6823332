"""Chunks of device streams: plain arrays with raw device times.

A chunk is the unit that flows from a device through the rig into the recording being written.
Nothing here converts a time: raw device times are stored unchanged, and clock maps are added
later (docs/decisions/time.md). All times are int64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

I64 = npt.NDArray[np.int64]
F32 = npt.NDArray[np.float32]
F64 = npt.NDArray[np.float64]
U8 = npt.NDArray[np.uint8]
U16 = npt.NDArray[np.uint16]


@dataclass(frozen=True)
class EventChunk:
    """Events in time order, each array of shape (n,)."""

    x: U16
    """Column, pixels from the left."""
    y: U16
    """Row, pixels from the top."""
    p: U8
    """Polarity: 1 brighter, 0 darker."""
    t_us: I64
    """Camera clock, microseconds, never decreasing."""

    def __len__(self) -> int:
        return len(self.t_us)

    @staticmethod
    def empty() -> EventChunk:
        """Return a chunk without events."""
        none = np.empty(0, np.uint16)
        return EventChunk(none, none, np.empty(0, np.uint8), np.empty(0, np.int64))

    @staticmethod
    def joined(parts: Sequence[EventChunk]) -> EventChunk:
        """Return chunks that follow each other in time as one; a single one is not copied."""
        if len(parts) == 1:
            return parts[0]
        if not parts:
            return EventChunk.empty()
        names = ("x", "y", "p", "t_us")
        return EventChunk(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


@dataclass(frozen=True)
class PulseChunk:
    """Rising edges as one device saw them, of the sync line or of another one, shape (n,)."""

    t_ns: I64
    """Clock of that device, nanoseconds (a microsecond counter times 1,000)."""

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class ClockReads:
    """A device's clock, read by the host between a question and its answer, n times."""

    device_ns: I64
    """Reading of the device's clock, nanoseconds, shape (n,)."""
    before_ns: I64
    """Host's monotonic clock when it asked, nanoseconds, shape (n,)."""
    after_ns: I64
    """Host's monotonic clock when it had the answer, nanoseconds, shape (n,)."""

    def __len__(self) -> int:
        return len(self.device_ns)


@dataclass(frozen=True)
class PoseChunk:
    """Arm poses as the controller reported them, n of them."""

    t_ns: I64
    """Controller clock, nanoseconds, shape (n,)."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    xyz_mm: F64
    """Tool centre point in the arm's base frame, mm, shape (n, 3)."""
    rotvec_deg: F64
    """Rotation vector, degrees, shape (n, 3)."""

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class FrameChunk:
    """Frames of the outside camera in order, n of them: images, or the marker positions in them."""

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

    def __len__(self) -> int:
        return len(self.t_ns)


@dataclass(frozen=True)
class WrenchChunk:
    """Forces and torques of one sensor in its own axes, n of them; a chunk of a named stream."""

    KIND: ClassVar[str] = "wrench"

    t_ns: I64
    """Sensor's clock, nanoseconds, shape (n,)."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    force_n: F64
    """Force along the sensor's axes, newtons, shape (n, 3)."""
    torque_nm: F64
    """Torque about the sensor's axes, newton metres, shape (n, 3)."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @staticmethod
    def empty() -> WrenchChunk:
        """A chunk without rows."""
        none = np.empty(0, np.int64)
        return WrenchChunk(none, none, np.empty((0, 3)), np.empty((0, 3)))


@dataclass(frozen=True)
class ScalarChunk:
    """Readings of one quantity, such as a temperature, n of them; a chunk of a named stream."""

    KIND: ClassVar[str] = "scalar"

    t_ns: I64
    """Sensor's clock, nanoseconds, shape (n,); `host_ns` again from a sensor without a clock."""
    host_ns: I64
    """Host's monotonic clock at reception, nanoseconds, shape (n,)."""
    value: F64
    """Readings in `unit`, shape (n,)."""
    unit: str = ""
    """Unit of the readings, such as ``degC``; the same over a whole stream."""

    def __len__(self) -> int:
        return len(self.t_ns)

    @staticmethod
    def empty(unit: str = "") -> ScalarChunk:
        """Return a chunk without readings."""
        none = np.empty(0, np.int64)
        return ScalarChunk(none, none, np.empty(0), unit)


StreamChunk = WrenchChunk | ScalarChunk
"""Chunks that a named stream in the trial's own file may be made of;
`storage.trials.hdf5_writer.STREAMS` has the columns of each."""
CameraChunk = EventChunk | FrameChunk | PulseChunk | ClockReads
"""Chunks of a further camera, whose stream has its own file: its events or frames, the sync
pulses that it saw, and reads of its clock."""
EVENTS_KIND, FRAMES_KIND = "events", "frames"
"""Kinds of the named streams of further cameras."""


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

    def add_events(self, chunk: EventChunk) -> None:
        """Append events (time order over all calls)."""

    def add_event_pulses(self, chunk: PulseChunk) -> None:
        """Append sync pulses seen by the event camera."""

    def add_arm_pulses(self, chunk: PulseChunk) -> None:
        """Append sync pulses seen by the arm's digital input."""

    def add_sync_pulses(self, chunk: PulseChunk) -> None:
        """Append the pulses that the sync box says it sent, on its own clock."""

    def add_exposures(self, chunk: PulseChunk) -> None:
        """Append the starts of exposures that the sync box saw, on its own clock."""

    def add_box_reads(self, chunk: ClockReads) -> None:
        """Append reads of the sync box's clock."""

    def add_frame_camera_reads(self, chunk: ClockReads) -> None:
        """Append reads of the frame camera's clock."""

    def add_poses(self, chunk: PoseChunk) -> None:
        """Append arm poses."""

    def add_frames(self, chunk: FrameChunk) -> None:
        """Append frames."""

    def add_stream(self, name: str, chunk: StreamChunk | CameraChunk) -> None:
        """Append to the stream of this name, which keeps the kind of its first chunk."""


class NullSink:
    """A sink that drops every stream; a subclass takes some of them."""

    def _drop(self, chunk: Any) -> None:
        """Drop a chunk."""

    add_events = add_event_pulses = add_arm_pulses = add_sync_pulses = _drop
    add_exposures = add_box_reads = add_frame_camera_reads = add_poses = add_frames = _drop

    def add_stream(self, name: str, chunk: Any) -> None:
        """Drop a chunk of a named stream."""


Json = dict[str, Any]
