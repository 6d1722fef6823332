"""ROS messages: those that trials are published as with their bytes (CDR), and their fields.

Definitions are those of ROS 2 and of event_camera_msgs, with the messages that they contain, in the
form that MCAP calls ``ros2msg``. Bytes are CDR as ROS 2 has it: four bytes that say little endian,
then every field at a multiple of its size. Those of `sliplab_msgs` are ours.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.storage.formats.foreign import FormatError
from sliplab.storage.streams import MOST_RANK, NUMBERS, U8, EventChunk

EVENTS, IMAGE, POSE, WRENCH = (
    "event_camera_msgs/msg/EventPacket",
    "sensor_msgs/msg/Image",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
)
PULSE, PHASE, ONSET, SCALAR, COLUMN = (
    f"sliplab_msgs/msg/{name}" for name in ("Pulse", "Phase", "Onset", "Scalar", "Column")
)
MONO = "mono"
"""The encoding of events: 64 bits each, see `pack_mono`."""
MONO8 = "mono8"
_PARTS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
}
_HEADED = ("std_msgs/Header", "builtin_interfaces/Time")
_MESSAGES: dict[str, tuple[str, tuple[str, ...]]] = {
    EVENTS: (
        "uint32 height\nuint32 width\nuint64 seq\nuint64 time_base\nstring encoding\n"
        "bool is_bigendian\nuint8[] events",
        (),
    ),
    IMAGE: (
        "uint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\n"
        "uint8[] data",
        (),
    ),
    POSE: (
        "geometry_msgs/Pose pose",
        ("geometry_msgs/Pose", "geometry_msgs/Point", "geometry_msgs/Quaternion"),
    ),
    WRENCH: ("geometry_msgs/Wrench wrench", ("geometry_msgs/Wrench", "geometry_msgs/Vector3")),
    PULSE: ("# on the clock of the device that saw it\nint64 device_ns", ()),
    PHASE: (
        "# of the motion; begins at the stamp\nstring phase\n"
        "# on the time line\nint64 end_ns\nbool recorded",
        (),
    ),
    ONSET: (
        "# incipient or gross\nstring kind\n# that gave it; own: the one that the protocol names\n"
        "string rule\n# on the time line\nint64 t_ns\n# why it is doubted, empty where it is not\n"
        "string doubt",
        (),
    ),
    SCALAR: ("float64 value\nstring unit", ()),
    COLUMN: (
        "# rows of a column as the device gave them; docs/store.md of SlipLab\n"
        "# data.h5, or the file of a further camera\nstring file\nstring column\nstring unit\n"
        "# numpy's, little endian\nstring dtype\n# of a row\nuint32[] shape\nuint8[] data",
        (),
    ),
}


def definition(message: str) -> bytes:
    """Return the definition of a message with those that it contains, as ``ros2msg``."""
    text, contained = _MESSAGES[message]
    parts = [f"std_msgs/Header header\n{text}"]
    parts += [f"MSG: {name}\n{_PARTS[name]}" for name in (*_HEADED, *contained)]
    return f"\n{'=' * 80}\n".join(parts).encode()


class CdrWriter:
    """Bytes of one message, field after field, beginning with its header.

    Args:
        t_ns: stamp, ns on the trial's time line.

    Raises:
        FormatError: the stamp needs more than the 32 bits of seconds that ROS 2 has.
    """

    def __init__(self, t_ns: int, frame: str) -> None:
        self._data = bytearray(b"\x00\x01\x00\x00")
        seconds, nanoseconds = divmod(int(t_ns), 1_000_000_000)
        if not -(2**31) <= seconds < 2**31:
            raise FormatError(f"has the time {t_ns} ns, which ROS 2's 32 bits of seconds lack")
        self.pack("i", seconds).pack("I", nanoseconds).text(frame)

    def pack(self, kind: str, *values: float) -> CdrWriter:
        """Append numbers of one kind, a letter of `struct`."""
        size = struct.calcsize(kind)
        self._data += bytes(-(len(self._data) - 4) % size)
        self._data += struct.pack(f"<{len(values)}{kind}", *values)
        return self

    def text(self, text: str) -> CdrWriter:
        """Append a string."""
        data = text.encode() + b"\x00"
        self.pack("I", len(data))
        self._data += data
        return self

    def block(self, data: bytes | memoryview) -> CdrWriter:
        """Append a sequence of bytes."""
        self.pack("I", len(data))
        self._data += data
        return self

    def done(self) -> bytes:
        """Return the message."""
        return bytes(self._data)


class Fields:
    """Fields of one message, one after the other, beginning with its header.

    Attributes:
        t_ns: stamp, ns.

    Args:
        ros1: it is one of ROS 1, whose fields follow each other without a gap.

    Raises:
        FormatError: it is not little-endian CDR, or ends early; also from every method.
    """

    def __init__(self, data: bytes, *, ros1: bool = False) -> None:
        self._data, self._at, self.ros1 = data, 0 if ros1 else 4, ros1
        if ros1:
            self.number("I")  # counts messages
        elif data[:2] != b"\x00\x01":
            raise FormatError("holds a message that is not little-endian CDR")
        seconds, nanoseconds = self.number("I" if ros1 else "i"), self.number("I")
        self.t_ns = seconds * 1_000_000_000 + nanoseconds
        self.frame = self.text()

    def number(self, kind: str) -> int:
        """Read an integer of a kind, a letter of `struct`."""
        size = struct.calcsize(kind)
        if not self.ros1:
            self._at += -(self._at - 4) % size
        (value,) = struct.unpack(f"<{kind}", self._take(size))
        return int(value)

    def text(self) -> str:
        """Read a string."""
        data = self._take(self.number("I"))
        try:
            return bytes(data).rstrip(b"\x00").decode()
        except UnicodeDecodeError:
            raise FormatError("holds a message with text that is not UTF-8") from None

    def block(self) -> memoryview:
        """Read a sequence of bytes."""
        return self._take(self.number("I"))

    def rest(self) -> memoryview:
        """Read all that is left."""
        return self._take(len(self._data) - self._at)

    def _take(self, size: int) -> memoryview:
        end = self._at + size
        if end > len(self._data):
            raise FormatError("holds a message that is cut short")
        found = memoryview(self._data)[self._at : end]
        self._at = end
        return found


@dataclass(frozen=True)
class EventPacket:
    """A message of event_camera_msgs: events of one camera, encoded."""

    t_ns: int
    width: int
    height: int
    seq: int
    time_base: int
    encoding: str
    big_endian: bool
    data: memoryview

    @staticmethod
    def parse(fields: Fields) -> EventPacket:
        """Read one. Raises FormatError where it is damaged."""
        height, width = fields.number("I"), fields.number("I")
        seq, time_base, encoding = fields.number("Q"), fields.number("Q"), fields.text()
        big, data = fields.number("B") != 0, fields.block()
        return EventPacket(fields.t_ns, width, height, seq, time_base, encoding, big, data)


@dataclass(frozen=True)
class Image:
    """A message of sensor_msgs: one frame, grey levels, shape (height, width)."""

    t_ns: int
    image: U8

    @staticmethod
    def parse(message: bytes) -> Image:
        """Read one. Raises FormatError where it is damaged or not ``mono8``."""
        fields = Fields(message)
        height, width, encoding = fields.number("I"), fields.number("I"), fields.text()
        fields.number("B")
        step, data = fields.number("I"), fields.block()
        if encoding != MONO8:
            raise FormatError(f"holds frames as {encoding!r:.40}; {MONO8} is read")
        if width < 1 or height < 1 or step < width or len(data) != step * height:
            raise FormatError(f"holds a frame of {width} x {height} in {len(data)} bytes")
        rows = np.frombuffer(data, np.uint8).reshape(height, step)
        return Image(fields.t_ns, rows[:, :width])


_NUMBERS = frozenset(np.dtype(name).newbyteorder("<").str for name in NUMBERS)


@dataclass(frozen=True)
class RowsMessage:
    """A message of ours: rows of a column of one of the trial's files."""

    file: str
    column: str
    unit: str
    values: npt.NDArray[np.generic]

    @staticmethod
    def parse(message: bytes) -> RowsMessage:
        """Read one. Raises FormatError where it is damaged."""
        fields = Fields(message)
        file, column, unit, kind = (fields.text() for _ in range(4))
        shape = tuple(fields.number("I") for _ in range(min(fields.number("I"), MOST_RANK + 1)))
        data = fields.block()
        if kind not in _NUMBERS or len(shape) > MOST_RANK:
            raise FormatError(f"holds {column!r:.40} as {kind!r:.40}, which no column is")
        row = np.dtype(kind).itemsize * int(np.prod(shape, dtype=object))
        if row == 0 or len(data) % row:
            raise FormatError(f"holds {column!r:.40} in parts of rows")
        values = np.frombuffer(data, kind).reshape(-1, *shape)
        return RowsMessage(file, column, unit, values)

    def message(self, t_ns: int) -> bytes:
        """Return the message."""
        values = np.ascontiguousarray(self.values, self.values.dtype.newbyteorder("<"))
        shape = values.shape[1:]
        cdr = CdrWriter(t_ns, "").text(self.file).text(self.column).text(self.unit)
        cdr.text(values.dtype.str).pack("I", len(shape))
        for size in shape:
            cdr.pack("I", size)
        return cdr.block(values.tobytes()).done()


def event_packet(
    t_ns: int, frame: str, size: tuple[int, int], seq: int, chunk: EventChunk
) -> bytes:
    """Return a packet of events whose times are within 4 s, encoded as `MONO`.

    Args:
        size: columns and rows of the camera.
    """
    base_ns = int(chunk.t_us[0]) * 1000
    cdr = CdrWriter(t_ns, frame).pack("I", size[1], size[0]).pack("Q", seq, base_ns)
    return cdr.text(MONO).pack("B", 0).block(pack_mono(chunk, base_ns)).done()


def pack_mono(chunk: EventChunk, base_ns: int) -> bytes:
    """Encode events as event_camera_codecs' ``mono``: 64 bits each, little endian.

    Bits 0 to 31 are the time after `base_ns`, ns; 32 to 47 the column; 48 to 62 the row; 63 is set
    where a pixel became brighter.

    Raises:
        FormatError: a row needs more than 15 bits.
    """
    if int(chunk.y.max(initial=0)) >= 1 << 15:
        raise FormatError(f"has an event in row {chunk.y.max()}; the format ends at row 32767")
    words = (chunk.t_us * 1000 - base_ns).astype(np.uint64)
    words |= chunk.x.astype(np.uint64) << np.uint64(32)
    words |= chunk.y.astype(np.uint64) << np.uint64(48)
    words |= chunk.p.astype(np.uint64) << np.uint64(63)
    return words.astype("<u8").tobytes()


def unpack_mono(packet: EventPacket) -> tuple[npt.NDArray[np.int64], EventChunk]:
    """Decode a packet of `MONO`.

    Returns:
        The times in ns, and the events with their times rounded to whole microseconds.

    Raises:
        FormatError: it is of another encoding, or damaged.
    """
    if packet.encoding != MONO:
        raise FormatError(f"holds events encoded as {packet.encoding!r:.40}; {MONO} is read")
    if len(packet.data) % 8 or not packet.time_base < 2**63 - 2**32:
        raise FormatError("holds a packet of events that is damaged")
    words = np.frombuffer(packet.data, ">u8" if packet.big_endian else "<u8")
    t_ns = packet.time_base + (words & np.uint64(0xFFFFFFFF)).astype(np.int64)
    return t_ns, EventChunk(
        (words >> np.uint64(32) & np.uint64(0xFFFF)).astype(np.uint16),
        (words >> np.uint64(48) & np.uint64(0x7FFF)).astype(np.uint16),
        (words >> np.uint64(63)).astype(np.uint8),
        (t_ns + 500) // 1000,
    )


def image(t_ns: int, frame: str, levels: U8) -> bytes:
    """Return a frame, shape (height, width)."""
    height, width = levels.shape
    cdr = CdrWriter(t_ns, frame).pack("I", height, width).text(MONO8).pack("B", 0)
    return cdr.pack("I", width).block(levels.tobytes()).done()


def pose(t_ns: int, frame: str, xyz_mm: Sequence[float], quaternion: Sequence[float]) -> bytes:
    """Return a pose; the quaternion is (x, y, z, w)."""
    metres = [value / 1000 for value in xyz_mm]
    return CdrWriter(t_ns, frame).pack("d", *metres).pack("d", *quaternion).done()


def wrench(t_ns: int, frame: str, force_n: Sequence[float], torque_nm: Sequence[float]) -> bytes:
    """Return a force and a torque."""
    return CdrWriter(t_ns, frame).pack("d", *force_n).pack("d", *torque_nm).done()


def pulse(t_ns: int, frame: str, device_ns: int) -> bytes:
    """Return a pulse that a device saw."""
    return CdrWriter(t_ns, frame).pack("q", device_ns).done()


def phase(t_ns: int, name: str, end_ns: int, *, recorded: bool) -> bytes:
    """Return a phase of the motion."""
    return CdrWriter(t_ns, "").text(name).pack("q", end_ns).pack("B", recorded).done()


def onset(t_ns: int, kind: str, rule: str, doubt: str | None) -> bytes:
    """Return an onset of a label."""
    return CdrWriter(t_ns, "").text(kind).text(rule).pack("q", t_ns).text(doubt or "").done()


def scalar(t_ns: int, frame: str, value: float, unit: str) -> bytes:
    """Return a reading of a sensor."""
    return CdrWriter(t_ns, frame).pack("d", value).text(unit).done()
