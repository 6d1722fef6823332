"""Recordings as drivers and recorders of ROS write them, by the writers of rosbags and mcap."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from sliplab.storage.streams import EventChunk

PACKET, ARRAY = "event_camera_msgs/msg/EventPacket", "dvs_msgs/msg/EventArray"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
IMU = "sensor_msgs/msg/Imu"
BASE_NS = 1_700_000_000_000_000_000
SIZE = (346, 260)
_OWN = {
    PACKET: "std_msgs/Header header\nuint32 height\nuint32 width\nuint64 seq\nuint64 time_base\n"
    "string encoding\nbool is_bigendian\nuint8[] events\n",
    "dvs_msgs/msg/Event": "uint16 x\nuint16 y\n{time} ts\nbool polarity\n",
    ARRAY: "std_msgs/Header header\nuint32 height\nuint32 width\ndvs_msgs/Event[] events\n",
}
IDL = """module event_camera_msgs { module msg { struct EventPacket {
std_msgs::msg::Header header; unsigned long height; unsigned long width; unsigned long long seq;
unsigned long long time_base; string encoding; boolean is_bigendian; sequence<octet> events; }; };
};"""
Message = tuple[str, str, Any]
"""Topic, type, and message."""


def _typestore(*, ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    time = "time" if ros1 else "builtin_interfaces/Time"
    for kind, text in _OWN.items():
        store.register(get_types_from_msg(text.format(time=time), kind))
    return store


ROS1, ROS2 = _typestore(ros1=True), _typestore(ros1=False)


def sent(count: int = 2000, *, seed: int = 3) -> EventChunk:
    """Events in order of time from `BASE_NS` on, at whole microseconds."""
    rng = np.random.default_rng(seed)
    return EventChunk(
        rng.integers(0, SIZE[0], count).astype(np.uint16),
        rng.integers(0, SIZE[1], count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        BASE_NS // 1000 + np.cumsum(rng.integers(0, 40, count)).astype(np.int64),
    )


def parts(chunk: EventChunk, size: int = 250) -> list[EventChunk]:
    """Cut events into packets."""
    cuts = range(0, len(chunk), size)
    return [chunk[low : low + size] for low in cuts]


def of(store: Any, t_ns: int) -> Any:
    """A header with a stamp."""
    time = store.types["builtin_interfaces/msg/Time"](t_ns // 10**9, t_ns % 10**9)
    header = store.types["std_msgs/msg/Header"]
    return header(0, time, "cam") if store is ROS1 else header(time, "cam")


def packet(
    store: Any, t_ns: int, encoding: str, data: bytes, base_ns: int = 0, size: Any = SIZE
) -> Any:
    """A message with encoded events."""
    events = np.frombuffer(data, np.uint8)
    kind = store.types[PACKET]
    return kind(of(store, t_ns), size[1], size[0], 0, base_ns, encoding, False, events)


def array(store: Any, chunk: EventChunk) -> Any:
    """A message with a list of events."""
    one, time = store.types["dvs_msgs/msg/Event"], store.types["builtin_interfaces/msg/Time"]
    rows = [
        one(x, y, time(t // 10**6, t % 10**6 * 1000), bool(p))
        for x, y, p, t in zip(*(c.tolist() for c in vars(chunk).values()), strict=True)
    ]
    return store.types[ARRAY](of(store, int(chunk.t_us[0]) * 1000), SIZE[1], SIZE[0], rows)


def image(store: Any, t_ns: int, encoding: str, pixels: np.ndarray[Any, Any], **other: Any) -> Any:
    """A frame; the rows of `pixels`, shape (height, bytes), are as long as its step."""
    height, step = pixels.shape[0], pixels[0].nbytes
    width = other.get("width", pixels.shape[1])
    data = np.frombuffer(pixels.tobytes(), np.uint8)
    big = other.get("big_endian", 0)
    return store.types[IMAGE](of(store, t_ns), height, width, encoding, big, step, data)


def compressed(store: Any, t_ns: int, form: str, data: bytes) -> Any:
    """A frame as a picture."""
    return store.types[COMPRESSED](of(store, t_ns), form, np.frombuffer(data, np.uint8))


def mono(chunk: EventChunk, base_ns: int) -> bytes:
    """Encode as ``mono``: ns after the base, column, row and polarity of 64 bits."""
    x, y, p, t = (column.astype(np.uint64) for column in vars(chunk).values())
    return (
        (
            (t * np.uint64(1000) - np.uint64(base_ns))
            | x << np.uint64(32)
            | y << np.uint64(48)
            | p << np.uint64(63)
        )
        .astype("<u8")
        .tobytes()
    )


def libcaer(chunk: EventChunk, base_us: int) -> bytes:
    """Encode as ``libcaer``: valid, polarity, row and column of 32 bits, then us."""
    x, y, p, t = (column.astype(np.uint64) for column in vars(chunk).values())
    places = np.uint64(1) | p << np.uint64(1) | y << np.uint64(2) | x << np.uint64(17)
    words = np.stack([places, (t - np.uint64(base_us)) % np.uint64(1 << 31)], 1)
    return words.astype("<u4").tobytes()


def libcaer_cmp(chunk: EventChunk, base_us: int) -> bytes:
    """Encode as ``libcaer_cmp``: words that say what changed, rows alone or 8 in one."""
    words: list[int] = []
    high, low, column = 0, 0, -1
    rows = list(zip(*(c.tolist() for c in vars(chunk).values()), strict=True))
    for number, (x, y, p, t) in enumerate(rows):
        us = t - base_us
        if us >> 12 != high:
            high = us >> 12
            words.append(high & 0xF)  # as libcaer_driver, which keeps 4 bits
        if us & 0xFFF != low:
            low = us & 0xFFF
            words.append(1 << 12 | low)
        if x != column:
            column = x
            words.append(2 << 12 | x)
        if number % 3:
            words.append(3 << 12 | p << 11 | y)
        else:
            words += [4 << 12 | p << 11 | y & ~7, 5 << 12 | 1 << (y & 7)]
    return np.array(words, "<u2").tobytes()


class Evt3:
    """Encode as ``evt3``, with the state of the camera from packet to packet."""

    def __init__(self) -> None:
        self.high = self.low = self.row = -1

    def packet(self, chunk: EventChunk) -> bytes:
        words = []
        for x, y, p, t in zip(*(c.tolist() for c in vars(chunk).values()), strict=True):
            if t >> 12 & 0xFFF != self.high:
                self.high, self.low = t >> 12 & 0xFFF, 0
                words.append(8 << 12 | self.high)
            if t & 0xFFF != self.low:
                self.low = t & 0xFFF
                words.append(6 << 12 | self.low)
            if y != self.row:
                self.row = y
                words.append(y)
            words.append(2 << 12 | p << 11 | x)
        return np.array(words, "<u2").tobytes()


def packets(store: Any, encoding: str, chunk: EventChunk) -> list[Message]:
    """Messages with events in an encoding, 250 each."""
    evt3, found = Evt3(), []
    for part in parts(chunk):
        base_us = int(part.t_us[0])
        data = {
            "mono": lambda part=part, us=base_us: mono(part, us * 1000),
            "libcaer": lambda part=part, us=base_us: libcaer(part, us),
            "libcaer_cmp": lambda part=part, us=base_us: libcaer_cmp(part, us),
            "evt3": lambda part=part: evt3.packet(part),
        }.get(encoding, lambda: b"\0" * 8)()
        base = 0 if encoding == "evt3" else base_us * 1000
        message = packet(store, base_us * 1000, encoding, data, base)
        found.append(("/event_camera/events", PACKET, message))
    return found


def arrays(store: Any, chunk: EventChunk) -> list[Message]:
    """Messages with lists of events, 250 each."""
    return [("/dvs/events", ARRAY, array(store, part)) for part in parts(chunk)]


def frames(store: Any, count: int = 3) -> list[Message]:
    """Grey frames."""
    return [
        (
            "/camera/image_raw",
            IMAGE,
            image(store, BASE_NS + n, "mono8", np.full((4, 6), 10 * n, np.uint8)),
        )
        for n in range(count)
    ]


def serialised(store: Any, message: Any, kind: str) -> bytes:
    """The bytes of a message."""
    ros1 = store is ROS1
    return bytes((store.serialize_ros1 if ros1 else store.serialize_cdr)(message, kind))


def write_mcap(
    path: Path, messages: Iterable[Message], *, idl: bool = False, store: Any = ROS2
) -> None:
    """Write a file as rosbag2 does, or rather its plug-in of older versions."""
    form = ("ros1msg", "ros1") if store is ROS1 else ("ros2idl" if idl else "ros2msg", "cdr")
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=20_000, compression=CompressionType.ZSTD)
        writer.start("ros1" if store is ROS1 else "ros2", "a recorder")
        channels: dict[str, int] = {}
        for number, (topic, kind, message) in enumerate(messages):
            if topic not in channels:
                name = kind.replace("/msg/", "/") if store is ROS1 else kind
                text = IDL if idl else store.generate_msgdef(kind)[0]
                schema = writer.register_schema(name, form[0], text.encode())
                channels[topic] = writer.register_channel(topic, form[1], schema)
            at = BASE_NS + number
            data = message if isinstance(message, bytes) else serialised(store, message, kind)
            writer.add_message(channels[topic], at, data, at)
        writer.finish()


def write_bag(path: Path, messages: Iterable[Message], compression: Any = None) -> None:
    """Write a bag of ROS 1."""
    writer = Writer1(path)
    writer.chunk_threshold = 4000
    if compression is not None:
        writer.set_compression(compression)
    with writer:
        connections: dict[str, Any] = {}
        for number, (topic, kind, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS1)
            data = message if isinstance(message, bytes) else serialised(ROS1, message, kind)
            writer.write(connections[topic], BASE_NS + number, data)


def write_folder(
    path: Path, messages: Iterable[Message], storage: str = "sqlite3", compression: Any = None
) -> None:
    """Write the folder of a recording of ROS 2."""
    writer = Writer2(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    if compression is not None:
        writer.set_compression(*compression)
    with writer:
        connections: dict[str, Any] = {}
        for number, (topic, kind, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS2)
            data = message if isinstance(message, bytes) else serialised(ROS2, message, kind)
            writer.write(connections[topic], BASE_NS + number, data)
