"""Reader and writer of AEDAT4, the files of iniVation's cameras and of dv-processing.

A file is a line, a header that describes its streams in XML, and packets: stream, length, and a
flatbuffer, mostly compressed. It is not read through dv-processing, C++ code that trusts the file's
content, and not written through it, because that library accepts events one by one only.
Tests compare both directions with it. Times are microseconds, unchanged from the file.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt

from sliplab.protocols.later import Later
from sliplab.storage.formats.exported import event_size, has_events, recorded_triggers
from sliplab.storage.formats.flatbuffers import (
    GREY,
    FlatTable,
    events_buffer,
    frame_buffer,
    header_buffer,
    triggers_buffer,
)
from sliplab.storage.formats.foreign import (
    LATEST_US,
    MOST_PX,
    NO_TIME_NS,
    Damage,
    ForeignTrial,
    FormatError,
    Triggers,
    as_damage,
    empty_events,
    event_chunk,
    grey,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.kernels import njit
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import I64, U8, U16, EventChunk, FrameChunk
from sliplab.storage.trials.recording import Recording

if TYPE_CHECKING:
    import pyarrow as pa
else:
    pa = Later("pyarrow")

LINE = b"#!AER-DAT4.0\r\n"
EVENTS, FRAMES, TRIGGERS = "EVTS", "FRME", "TRIG"
SIMULATED = "simulated"
"""Part of the source's name in a file that was written from simulated data."""
_CODECS = {0: None, 1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}
_MOST_HEADER, _MOST_PACKET = 1 << 20, 1 << 28
_MOST_LOST = 1 << 53
_PACKET_EVENTS = 1 << 16
_PIECE = 1 << 20
_ZSTD = 3
_MOST_RATIO = 64
"""Ratio of a packet's content to its bytes up to which the size in its header is trusted."""
_START_OF_EXPOSURE, _END_OF_EXPOSURE = 3, 4
"""Fields of a frame."""
_COLOUR = {16: 3, 24: 4}
"""OpenCV's numbers of 8-bit pictures with three and four channels."""


@dataclass(frozen=True)
class Aedat4Stream:
    """One stream of a file: its kind, and the size of its images."""

    kind: str
    name: str
    size: tuple[int, int] | None
    source: str


@dataclass(frozen=True)
class Picture:
    """A frame: grey levels (height, width), middle of exposure in ns."""

    image: U8
    t_ns: int


class Aedat4File:
    """A file that is open for reading; a context manager.

    Args:
        end: byte before which packets are read, of a file that may be cut short; its own by
            default.

    Attributes:
        at: byte of the packet that was read last.

    Raises:
        FormatError: it is not an AEDAT4 file, or damaged.
        OSError: it cannot be read.
    """

    def __init__(self, path: Path, end: int | None = None) -> None:
        self.path = path
        self._handle = path.open("rb")
        self._buffer = bytearray(_PIECE)
        try:
            self._bytes = path.stat().st_size
            if (line := self._handle.read(len(LINE))) != LINE:
                if LINE.startswith(line):
                    raise Damage("is cut short in its first line")
                raise FormatError(
                    f"is not an AEDAT4 file: it starts with {line!r}, not with {LINE!r}"
                )
            header = self._exactly(_length(self._exactly(4), _MOST_HEADER))
            table = FlatTable.root(memoryview(_prefixed(header)), b"IOHE")
            self._codec = _CODECS.get(table.number(0, "<i"), "")
            if self._codec == "":
                raise FormatError("has an unknown compression")
            stated = table.number(1, "<q", -1)
            self.at = self._begin = self._handle.tell()
            self._end = self._bytes if stated <= 0 else stated
            self._short = (
                f"is cut short: its header puts the end of its packets at byte {stated}, "
                "and it has "
                f"{self._bytes} bytes"
                if stated > self._bytes
                else None
            )
            if end is not None:
                self._end = min(self._end, end)
            if not self._begin <= self._end <= self._bytes:
                raise Damage(self._short or f"puts the end of its packets at byte {self._end}")
            self._table = stated if 0 < stated < self._bytes else None
            self.streams = _streams(bytes(table.vector(2, 1)[1]))
        except BaseException:
            self._handle.close()
            raise

    def __enter__(self) -> Aedat4File:
        return self

    def __exit__(self, *_: object) -> None:
        self._handle.close()

    def first(self, kind: str) -> int | None:
        """Return the number of the first stream of a kind."""
        return next((n for n, s in sorted(self.streams.items()) if s.kind == kind), None)

    def whole(self) -> Lost | None:
        """Find the first packet that cannot be read; nothing is read from there on.

        Returns:
            The loss; None if the file is intact.
        """
        reason = self._short
        for kind, read in (
            (TRIGGERS, self._trigger_packets),
            (FRAMES, self._equal_pictures),
            (EVENTS, self._inside),
        ):
            number = self.first(kind)
            try:
                for _ in read(number) if number is not None else ():
                    pass
            except FormatError as error:
                self._end, reason = self.at, str(error)
        if reason is None:
            return None
        lost = {"events": self._lost(EVENTS), "frames": self._lost(FRAMES)}
        known = {key: count for key, count in lost.items() if count is not None}
        unread = self._bytes - self._end
        return Lost(at_byte=self._end, unread_bytes=unread, reason=reason, **known)

    def packets(self) -> int:
        """Return the number of packets of the first streams of events, triggers and frames."""
        numbers = [self.first(kind) for kind in (EVENTS, TRIGGERS, FRAMES)]
        return sum(stream in numbers for stream, _ in self._headers())

    def _equal_pictures(self, number: int) -> Iterator[Picture]:
        size = None
        for picture in self.pictures(number):
            if picture.image.shape != (size := size or picture.image.shape):
                raise FormatError("holds a frame of another size than the first")
            yield picture

    def _inside(self, number: int) -> Iterator[EventChunk]:
        for data in self._packets(number):
            words = _event_words(data)
            yield _split(words, empty_events(len(words) // 2))

    def _lost(self, kind: str) -> int | None:
        """Return the items of a stream behind the end, by the table that closes a whole file."""
        number = self.first(kind)
        if number is None or self._table is None:
            return None
        try:
            self._handle.seek(self._table)
            data = self._unpacked(self._exactly(min(self._bytes - self._table, _MOST_PACKET)))
            count = sum(
                row.number(2, "<q")
                for row in FlatTable.root(data, b"FTAB").tables(0)
                # a place in the table is behind the 8 bytes of its packet's header
                if row.number(1, "<i") == number and row.number(0, "<q") >= self._end + 8
            )
            return count if 0 <= count < _MOST_LOST else None
        except (FormatError, pa.ArrowException, OSError):
            return None

    def events(self, number: int) -> Iterator[EventChunk]:
        """Yield the events of a stream, packets together up to `_PACKET_EVENTS` events.

        Invalid events are left out; a packet with some is a separate chunk.

        A camera's packet has a few hundred events: the overhead per chunk would exceed their cost.
        """
        room = empty_events(_PACKET_EVENTS)
        filled = 0
        for data in self._packets(number):
            words = _event_words(data)
            count = len(words) // 2
            if filled and filled + count > len(room):
                yield room[:filled]
                filled = 0
                room = empty_events(_PACKET_EVENTS)
            if count > len(room):
                room = empty_events(count)
            found = _split(words, room[filled : filled + count])
            if len(found) == count:
                filled += count
                continue
            if filled:
                yield room[:filled]
                filled = 0
                room = empty_events(_PACKET_EVENTS)
            yield found
        if filled:
            yield room[:filled]

    def triggers(self, number: int) -> Triggers:
        """Return all triggers of a stream."""
        found = [one for packet in self._trigger_packets(number) for one in packet]
        times = np.array([t for t, _ in found], np.int64)
        return Triggers(times, np.array([kind for _, kind in found], np.uint8))

    def _trigger_packets(self, number: int) -> Iterator[list[tuple[int, int]]]:
        """Yield time, us, and kind of all triggers in a packet."""
        for data in self._packets(number):
            tables = FlatTable.root(data, b"TRIG").tables(0)
            yield [(table.number(0, "<q"), table.number(1, "<B")) for table in tables]

    def pictures(self, number: int) -> Iterator[Picture]:
        """Yield the frames of a stream, colours as grey levels."""
        for data in self._packets(number):
            table = FlatTable.root(data, b"FRME")
            t_ns, form = _middle_ns(table), table.number(5, "<b")
            width, height = table.number(6, "<h"), table.number(7, "<h")
            channels = 1 if form == GREY else _COLOUR.get(form, 0)
            count, pixels = table.vector(10, 1)
            if not channels or width <= 0 or height <= 0 or count != width * height * channels:
                raise FormatError(
                    f"holds a frame of {width} x {height} with {count} bytes of kind {form}; read "
                    "are 8-bit frames with 1, 3 or 4 channels (kinds 0, 16 and 24)"
                )
            levels = np.frombuffer(pixels, np.uint8).reshape(height, width, channels)
            yield Picture(grey(levels), t_ns)

    def _packets(self, number: int) -> Iterator[memoryview]:
        """Yield the unpacked packets of one stream; each is valid until the next."""
        for stream, size in self._headers():
            if stream != number:
                continue
            data = self._exactly(size)
            try:
                found = self._unpacked(data)
            except (pa.ArrowException, OSError) as error:
                raise FormatError(
                    f"contains a packet that cannot be decompressed, at byte {self.at}: {error}"
                ) from None
            yield found

    def _headers(self) -> Iterator[tuple[int, int]]:
        """Yield stream and length of every packet, with the file at its content."""
        at = self._begin
        while at < self._end:
            self.at = at
            self._handle.seek(at)
            stream, size = struct.unpack("<ii", self._exactly(8))
            if stream not in self.streams or not 0 <= size <= min(self._end - at - 8, _MOST_PACKET):
                cut = stream in self.streams and at + 8 + size > self._bytes
                raise FormatError(
                    f"{'is cut short: it ' if cut else ''}holds a packet of {size} bytes in stream "
                    f"{stream}, at byte {at}"
                )
            yield stream, size
            at += 8 + size

    def _unpacked(self, data: bytes) -> memoryview:
        """Return a packet's content, perhaps in a buffer that is used again."""
        if self._codec is None:
            return memoryview(data)
        if self._codec == "zstd" and 0 < (size := _zstd_size(data)) <= _MOST_RATIO * len(data):
            with suppress(pa.ArrowException, OSError):  # the stream below finds what is wrong
                return memoryview(pa.decompress(data, size, "zstd"))
        filled = 0
        with pa.CompressedInputStream(pa.BufferReader(data), self._codec) as stream:
            while part := stream.readinto(memoryview(self._buffer)[filled:]):
                filled += part
                if filled > _MOST_PACKET:
                    raise FormatError("contains a packet that is too large when decompressed")
                if filled == len(self._buffer):  # room for what comes, not for what a header says
                    self._buffer = self._buffer + bytearray(filled)
        return memoryview(self._buffer)[:filled]

    def _exactly(self, count: int) -> bytes:
        found = self._handle.read(count)
        if len(found) != count:
            raise Damage("is cut short")
        return found


def _middle_ns(frame: FlatTable) -> int:
    """Return the middle of a frame's exposure, or its time stamp without start and end, ns.

    The time stamp is the start of exposure in what dv-processing writes, and the middle in what
    older programs write, which leave start and end out.
    """
    start, end, stamp = (
        frame.number(field, "<q") for field in (_START_OF_EXPOSURE, _END_OF_EXPOSURE, 0)
    )
    if max(map(abs, (start, end, stamp))) >= LATEST_US:
        return NO_TIME_NS
    if start <= 0 or end <= 0:
        return stamp * 1000 if stamp >= 0 else NO_TIME_NS
    if end < start:
        raise FormatError(f"holds a frame whose exposure starts at {start} us and ends at {end} us")
    return (start + end) * 500


def _event_words(data: memoryview) -> Any:
    """Return two 64-bit words an event of a packet."""
    words = np.frombuffer(FlatTable.root(data, b"EVTS").vector(0, 16)[1], "<u8")
    if not words.flags.aligned:
        words = words.copy()
    words.flags.writeable = False  # `_split_events` is compiled for such
    return words


def _split(words: Any, chunk: EventChunk) -> EventChunk:
    """Fill a chunk from the words of its events; return it without the invalid ones."""
    if _split_events(words, chunk.x, chunk.y, chunk.p, chunk.t_us):
        return chunk
    return event_chunk(chunk.x, chunk.y, chunk.p, chunk.t_us)


@njit(cache=True, nogil=True)
def _split_events(words: npt.NDArray[np.uint64], x: U16, y: U16, p: U8, t: I64) -> bool:
    """Fill the columns of events from two 64-bit words each: time, and pixel with polarity.

    Returns:
        Whether every pixel and time can be right.
    """
    wrong: Any = False
    for i in range(len(words) // 2):
        now, place = np.int64(words[2 * i]), words[2 * i + 1]
        x[i] = column = place & np.uint64(0xFFFF)
        y[i] = row = place >> np.uint64(16) & np.uint64(0xFFFF)
        p[i] = place >> np.uint64(32) & np.uint64(1)
        t[i] = now
        wrong |= now < 0 or column >= MOST_PX or row >= MOST_PX or now >= LATEST_US
    return not wrong


def _length(data: bytes, most: int) -> int:
    count = int(struct.unpack("<I", data)[0])
    if count > most:
        raise FormatError(f"has a header of {count} bytes")
    return count


def _prefixed(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _zstd_size(frame: bytes) -> int:
    """Return the size of a zstd frame's content by its header (RFC 8878); 0 without one."""
    if len(frame) < 14 or frame[:4] != b"\x28\xb5\x2f\xfd":
        return 0
    single = frame[4] >> 5 & 1
    at = 6 - single + (0, 1, 2, 4)[frame[4] & 3]
    width = (single, 2, 4, 8)[frame[4] >> 6]
    return int.from_bytes(frame[at : at + width], "little") + (256 if width == 2 else 0)


def _streams(text: bytes) -> dict[int, Aedat4Stream]:
    if b"<!" in text:
        raise FormatError("has a header with entity definitions")
    try:
        root = ElementTree.fromstring(text.rstrip(b"\0").decode("utf-8"))
        found = {}
        for node in root.iterfind("./node[@name='outInfo']/node"):
            values = {item.get("key"): item.text or "" for item in node.iter("attr")}
            size = None
            if "sizeX" in values and "sizeY" in values:
                size = (int(values["sizeX"]), int(values["sizeY"]))
            kind = values.get("typeIdentifier", "")
            name = values.get("originalOutputName", kind)
            found[int(node.get("name", ""))] = Aedat4Stream(
                kind, name, size, values.get("source", "")
            )
    except (ElementTree.ParseError, ValueError) as error:
        raise FormatError(f"has a header that cannot be read: {error}") from None
    return found


class Aedat4Writer:
    """A file that is being written, packets compressed with zstd; a context manager.

    Args:
        streams: all streams that will be written, by number.
    """

    def __init__(self, path: Path, streams: dict[int, Aedat4Stream]) -> None:
        self._handle = path.open("wb")
        self._handle.write(LINE + header_buffer(_described(streams), _ZSTD))

    def __enter__(self) -> Aedat4Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self._handle.close()

    def events(self, number: int, chunk: EventChunk) -> None:
        """Append events; times must not run backwards, over all calls."""
        for start in range(0, len(chunk), _PACKET_EVENTS):
            self._write(number, events_buffer(chunk[start : start + _PACKET_EVENTS]))

    def triggers(self, number: int, found: Triggers) -> None:
        """Append triggers."""
        if len(found.t_us):
            self._write(number, triggers_buffer(found.t_us, found.kind))

    def picture(self, number: int, image: U8, t_us: int) -> None:
        """Append a frame of grey levels."""
        self._write(number, frame_buffer(image, t_us))

    def _write(self, number: int, made: bytes) -> None:
        packed = pa.compress(made, codec="zstd", asbytes=True)
        self._handle.write(struct.pack("<ii", number, len(packed)) + packed)


def _described(streams: dict[int, Aedat4Stream]) -> str:
    root = ElementTree.Element("dv", version="2.0")
    out = ElementTree.SubElement(root, "node", name="outInfo", path="/outInfo/")
    for number, stream in sorted(streams.items()):
        path = f"/outInfo/{number}/"
        node = ElementTree.SubElement(out, "node", name=str(number), path=path)
        for key, text in (
            ("compression", "ZSTD"),
            ("originalModuleName", "sliplab"),
            ("originalOutputName", stream.name),
            ("typeIdentifier", stream.kind),
        ):
            ElementTree.SubElement(node, "attr", key=key, type="string").text = text
        info = ElementTree.SubElement(node, "node", name="info", path=f"{path}info/")
        if stream.size is not None:
            for axis, value in zip("XY", stream.size, strict=True):
                item = ElementTree.SubElement(info, "attr", key=f"size{axis}", type="int")
                item.text = str(value)
        ElementTree.SubElement(info, "attr", key="source", type="string").text = stream.source
    return ElementTree.tostring(root, encoding="unicode")


def read_aedat4(path: Path, name: str) -> ForeignTrial:
    """Read a file as a trial called `name`: its first streams of events, triggers and frames.

    Raises:
        FormatError: it is damaged.
    """
    with Aedat4File(path) as file:
        return _trial(file, path, name, None)


def salvage_aedat4(path: Path, name: str) -> ForeignTrial:
    """Read the whole packets before the first damaged one, as `read_aedat4` reads a whole file.

    Raises:
        FormatError: its header is damaged.
    """
    with Aedat4File(path, path.stat().st_size) as file:
        lost = file.whole()
        end = path.stat().st_size if lost is None else lost.at_byte
        return replace(_trial(file, path, name, end), lost=lost, packets=file.packets())


def _trial(file: Aedat4File, path: Path, name: str, end: int | None) -> ForeignTrial:
    events, triggers, frames = (file.first(kind) for kind in (EVENTS, TRIGGERS, FRAMES))
    main = frames if events is None else events
    if main is None:
        raise FormatError("contains no event stream")
    streams = file.streams
    with as_damage():
        found = None if triggers is None else file.triggers(triggers)
        first = None if frames is None else next(file.pictures(frames), None)
        frame_px = None if first is None else (first.image.shape[1], first.image.shape[0])
    left_out = [s.name for n, s in streams.items() if n not in {events, triggers, frames}]

    def all_events() -> Iterator[EventChunk]:
        with Aedat4File(path, end) as again:
            yield from again.events(events) if events is not None else ()

    def all_frames() -> Iterator[FrameChunk]:
        with Aedat4File(path, end) as again:
            for number, picture in enumerate(again.pictures(frames or 0)):
                t_ns = np.full(1, picture.t_ns, np.int64)
                yield FrameChunk(
                    picture.image[None], np.full(1, number), t_ns, t_ns, np.zeros(1, np.uint8)
                )

    return ForeignTrial(
        name,
        path.name,
        all_events,
        "as the file has it: Unix time, us, where a camera wrote it",
        lambda: None if events is None else streams[events].size,
        found,
        None if frame_px is None else all_frames,
        frame_px,
        simulated=SIMULATED in streams[main].source,
        about={"camera": streams[main].source, "left_out": left_out},
        unknown=("sync grade", "poses", "motion", "condition"),
    )


def _export(recording: Recording, path: Path, stream: str) -> dict[str, int]:
    """Write everything on the event camera's clock, us; frames at the middle of their exposure."""
    if not (has_events(recording, stream) or recording.has_video):
        raise ValueError("has neither events nor a video; AEDAT4 can store nothing else")
    source = f"sliplab {SIMULATED}" if recording.simulated else "sliplab"
    triggers = recorded_triggers(recording, stream)
    streams = {0: Aedat4Stream(EVENTS, "events", event_size(recording, stream), source)}
    frame_us = np.empty(0, np.int64)
    if recording.has_video:
        frame_us = recording.frame_times() // 1000
        if has_events(recording, stream):
            frame_us = recording.clock(stream).to_device(recording.frame_times()) // 1000
        first = recording.frame(0) if len(frame_us) else np.empty((1, 1))
        height, width = first.shape
        streams[1] = Aedat4Stream(FRAMES, "frames", (width, height), source)
    streams[2] = Aedat4Stream(TRIGGERS, "triggers", None, source)
    if len(frame_us) and int(frame_us.min()) < 0:
        raise ValueError("has frames before the event camera's clock started")
    with Aedat4Writer(path, streams) as file:
        count = 0
        with recording.open(stream) as reader:
            for chunk in reader.event_chunks():
                file.events(0, chunk)
                count += len(chunk)
        file.triggers(2, triggers)
        if recording.has_video:
            for image, t_us in zip(recording.frames(), frame_us.tolist(), strict=True):
                file.picture(1, image, t_us)
    return {"events": count, "frames": len(frame_us), "triggers": len(triggers.t_us)}


AEDAT4 = Format(
    (".aedat4",),
    lambda path, head: head.startswith(LINE),
    read_aedat4,
    salvage_aedat4,
    export=_export,
)
