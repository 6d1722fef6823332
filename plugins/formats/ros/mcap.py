"""Reader of MCAP files with ROS messages: those that SlipLab published, and other recordings.

A file of ours has a trial with all that belongs to it; `recording` makes one of any other.
Records and chunks are read by the `mcap` library, within limits: a foreign file says how large its
parts are.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib import util
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
import numpy.typing as npt

from sliplab.plugins.formats.ros import messages as ros2
from sliplab.plugins.formats.ros.card import CARD
from sliplab.plugins.formats.ros.mcap_writer import (
    FORMAT,
    LABEL_ARRAYS,
    LABEL_JSON,
    LIBRARY,
    METADATA,
    SYNC_JSON,
    write_mcap,
)
from sliplab.plugins.formats.ros.original import Original
from sliplab.plugins.formats.ros.recording import FRAMES, MessageSource, recording
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import parse_yaml
from sliplab.storage.errors import StoreError
from sliplab.storage.files import json_text, safe_name
from sliplab.storage.formats.foreign import (
    Damage,
    ForeignTrial,
    FormatError,
    as_damage,
    event_chunk,
    read_head,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.formats.stored import CampaignTexts
from sliplab.storage.schema.document import Document, DocumentError, NewerFormat
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.schema.trial import Lost, Provenance, SyncResult, TrialRecord
from sliplab.storage.streams import U8, EventChunk, Json
from sliplab.storage.trials.checksums import PROVENANCE, RECORD
from sliplab.storage.trials.store import INFO, PROTOCOL, RIG

MAGIC = b"\x89MCAP0\r\n"
_MOST_RECORD, _MOST_CHUNK, _MOST_KEPT = 1 << 28, 1 << 28, 1 << 30
_FOOTER, _FOOTER_CODE = struct.Struct("<BQQQI"), 2
"""Kind and length of a footer's record, places of the summary and of its index, checksum."""
_FAULTS = (
    struct.error,
    OverflowError,
    ValueError,
    KeyError,
    RuntimeError,
    MemoryError,
    OSError,
    EOFError,
)
"""Exceptions of the `mcap` library for a damaged file, besides its own errors."""
_MOST_MESSAGES = 1 << 62
_SCHEMAS = ("ros2msg", "ros2idl", "ros1msg")
"""Encodings of the definitions of ROS messages."""
DocumentT = TypeVar("DocumentT", bound=Document)


@dataclass
class _Found:
    """Contents of a file, except events and frames."""

    topics: dict[str, str] = field(default_factory=dict)
    """Message type by topic, in the order of the file."""
    ros1: set[str] = field(default_factory=set)
    """Topics whose messages are serialised as in ROS 1."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Topic by the name of a camera, of a file of ours."""
    attached: dict[str, bytes] = field(default_factory=dict)
    about: dict[str, str] | None = None
    columns: dict[tuple[str, str], list[ros2.RowsMessage]] = field(default_factory=dict)
    library: str = ""
    """The program that wrote the file."""


@dataclass
class _FileHead:
    """The beginning of a file: the records before the byte `end`, all by default.

    `at` is the byte of the record that is being read.
    """

    end: float = float("inf")
    at: int = 0
    records: int = 0


def read_mcap(path: Path, name: str) -> ForeignTrial:
    """Read a file.

    Raises:
        FormatError: it is damaged, or has no events and no trial of a store.
        ModuleNotFoundError: the extra `publish` is missing.
    """
    found = _scan(path)
    if found.about is not None:
        with as_damage():
            return _ours(path, found)
    return recording(path, name, _source(path, found))


def mcap_source(path: Path) -> MessageSource:
    """Return the messages of a file as a recording by other programs has them.

    Raises:
        FormatError: it is damaged. ModuleNotFoundError: the extra `publish` is missing.
    """
    return _source(path, _scan(path))


def salvage_mcap(path: Path, name: str) -> ForeignTrial:
    """Read the records before the first damaged one, chunks whole or not at all.

    Raises:
        FormatError: there is nothing whole, or it is a published trial: its record is at its end,
            which a file that is cut short has lost, and it is imported whole or not at all.
        ModuleNotFoundError: the extra `publish` is missing.
    """
    found, part = _Found(), _FileHead()
    try:
        for _ in _messages(path, found, (), part=part):
            pass
    except FormatError as error:
        reason = str(error)
    else:
        return read_mcap(path, name)
    if found.about is not None or found.library.startswith(LIBRARY):
        raise Damage(
            f"{reason}; a published trial is imported whole or not at all, for its record, which "
            "says whether it is simulated, is at its end: publish it again"
        )
    # topics after the damage are no longer readable
    found = _Found()
    frames = Counter(
        topic for _, topic, _ in _messages(path, found, FRAMES, part=_FileHead(part.at))
    )
    trial = recording(path, name, _source(path, found, part.at))
    lost = Lost(at_byte=part.at, unread_bytes=path.stat().st_size - part.at, reason=reason)
    stated = _messages_said(path, trial.about.get("frame_topic"))
    if stated is not None:
        there = frames[trial.about["frame_topic"]]
        lost = lost.model_copy(update={"frames": max(stated - there, 0)})
    return replace(trial, lost=lost, packets=part.records)


def _messages_said(path: Path, topic: str | None) -> int | None:
    """Return the number of messages of a topic by the statistics at a file's end, if it has any."""
    from mcap.exceptions import McapError
    from mcap.records import Channel, Statistics
    from mcap.stream_reader import StreamReader

    channels: set[int] = set()
    counts: dict[int, int] | None = None
    with path.open("rb") as handle, suppress(McapError, *_FAULTS):
        size = path.stat().st_size
        handle.seek(size - _FOOTER.size - len(MAGIC))
        code, _, start, *_ = _FOOTER.unpack(handle.read(_FOOTER.size))
        if topic is None or code != _FOOTER_CODE or not 0 < start < size:
            return None
        handle.seek(start)
        within: Any = _Within(handle, size)  # StreamReader calls read alone
        reader = StreamReader(within, skip_magic=True, record_size_limit=_MOST_RECORD)
        for record in reader.records:
            if isinstance(record, Channel) and record.topic == topic:
                channels.add(record.id)
            elif isinstance(record, Statistics):
                counts = record.channel_message_counts
    found = None if counts is None else sum(counts.get(channel, 0) for channel in channels)
    return found if found is not None and channels and found < _MOST_MESSAGES else None


class _Within:
    """A file whose reads are limited to its size, since memory is allocated for the request."""

    def __init__(self, file: BinaryIO, size: int) -> None:
        self._file, self._size = file, size

    def read(self, count: int) -> bytes:
        """Return up to `count` bytes."""
        return self._file.read(min(count, max(self._size - self._file.tell(), 0)))


def _scan(path: Path) -> _Found:
    """Read all of a file once, and check it."""
    found = _Found()
    retained = 0
    for kind, topic, data in _messages(path, found, {ros2.COLUMN}):
        if kind != ros2.COLUMN:
            continue
        retained += len(data)
        if retained > _MOST_KEPT:
            raise FormatError(f"holds more than {_MOST_KEPT >> 30} GiB in {topic}")
        rows = ros2.RowsMessage.parse(data)
        found.columns.setdefault((rows.file, rows.column), []).append(rows)
    return found


def _messages(
    path: Path,
    found: _Found | None,
    kinds: Collection[str],
    topic: str | None = None,
    part: _FileHead | None = None,
) -> Iterator[tuple[str, str, bytes]]:
    """Yield messages of some types, and of one topic: type, topic and bytes, as the file has them.

    Raises:
        FormatError: the file is damaged.
    """
    from mcap.exceptions import InvalidMagic, McapError
    from mcap.records import Attachment, Channel, Chunk, DataEnd, Header, Message, Metadata, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}

    def one(record: Any) -> Iterator[tuple[str, str, bytes]]:
        if isinstance(record, Schema):
            schemas[record.id] = record.name if record.encoding in _SCHEMAS else ""
        elif isinstance(record, Channel):
            ros1 = record.message_encoding == "ros1"
            kind = (
                schemas.get(record.schema_id, "")
                if ros1 or record.message_encoding == "cdr"
                else ""
            )
            if kind.count("/") == 1:  # as ROS 1 names it
                kind = kind.replace("/", "/msg/")
            channels[record.id] = kind, record.topic
            if found is not None:
                found.topics.setdefault(record.topic, kind)
                if ros1:
                    found.ros1.add(record.topic)
                if (camera := record.metadata.get("camera")) is not None:
                    found.cameras[camera] = record.topic
        elif isinstance(record, Message):
            if record.channel_id not in channels:
                raise FormatError("holds a message of no channel")
            kind, of = channels[record.channel_id]
            if kind in kinds and topic in (None, of):
                yield kind, of, record.data
        elif isinstance(record, Attachment) and found is not None:
            found.attached[record.name] = record.data
        elif isinstance(record, Metadata) and found is not None and record.name == METADATA:
            found.about = dict(record.metadata)
        elif isinstance(record, Header) and found is not None:
            found.library = record.library

    part = part or _FileHead()
    try:
        with path.open("rb") as handle:
            within: Any = _Within(handle, path.stat().st_size)  # StreamReader calls read alone
            reader = StreamReader(within, emit_chunks=True, record_size_limit=_MOST_RECORD)
            records = iter(reader.records)
            while part.at < part.end and (record := next(records, None)) is not None:
                if not isinstance(record, DataEnd):
                    for item in _opened(record) if isinstance(record, Chunk) else (record,):
                        yield from one(item)
                part.at, part.records = handle.tell(), part.records + 1
    except FormatError as error:
        raise Damage(str(error)) from None
    except InvalidMagic as error:
        if part.at or MAGIC.startswith(read_head(path)):
            raise Damage(f"is cut short: {error}") from None
        raise FormatError(f"is not an MCAP file: {error}") from None
    except McapError as error:
        raise Damage(f"is damaged or cut short: {str(error) or type(error).__name__}") from None
    except _FAULTS as error:
        raise Damage(f"is damaged or cut short: {error}") from None


def _opened(chunk: Any) -> list[Any]:
    """Unpack a chunk, within limits, and check its checksum."""
    import zstandard
    from mcap.stream_reader import breakup_chunk

    if chunk.uncompressed_size > _MOST_CHUNK:
        raise FormatError(f"holds a chunk of {chunk.uncompressed_size} bytes")
    try:
        if chunk.compression == "zstd":
            # the library allocates what the frame says
            if zstandard.frame_content_size(chunk.data) not in (-1, chunk.uncompressed_size):
                raise FormatError("holds a chunk of another size than it says")
        elif chunk.compression == "lz4":
            chunk = _unpacked_lz4(chunk)
        elif chunk.compression:
            raise FormatError(f"is compressed by {chunk.compression!r:.40}, which is unknown")
        return breakup_chunk(chunk, validate_crc=True)
    except zstandard.ZstdError as error:
        raise FormatError(f"holds a damaged chunk: {error}") from None


def _unpacked_lz4(chunk: Any) -> Any:
    from dataclasses import replace

    from lz4.frame import LZ4FrameDecompressor

    data = LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size + 1)
    if len(data) != chunk.uncompressed_size:
        raise FormatError("holds a chunk of another size than it says")
    return replace(chunk, data=data, compression="")


def _ours(path: Path, found: _Found) -> ForeignTrial:
    """Return the trial of a store that a file holds."""
    about = found.about or {}
    if about.get("format") != FORMAT:
        raise FormatError(
            f"has the format {about.get('format')!r:.20} of a published trial; this version of "
            f"SlipLab reads {FORMAT}"
        )
    for name in (RECORD, PROVENANCE, INFO, PROTOCOL, RIG):
        if name not in found.attached:
            raise FormatError(f"lacks {name} of its trial")
    for name, data in found.attached.items():
        if about.get(f"sha256 {name}") != hashlib.sha256(data).hexdigest():
            raise FormatError(f"has a {name!r:.60} that does not match its checksum")
    record = _document(found, RECORD, TrialRecord)
    label = _document(found, LABEL_JSON, TrialLabel) if LABEL_JSON in found.attached else None
    sync = _document(found, SYNC_JSON, SyncResult) if SYNC_JSON in found.attached else None
    try:
        safe_name(record.trial)
        rate_hz = int(about.get("frame_rate_hz", "100"))
    except (StoreError, ValueError) as error:
        raise FormatError(f"holds no trial: {error}") from None
    if not 0 < rate_hz < 1_000_000:
        raise FormatError(f"has {rate_hz} frames a second")
    events = {
        camera: _our_events(path, topic)
        for camera, topic in found.cameras.items()
        if found.topics[topic] == ros2.EVENTS
    }
    frames = {
        camera: _our_frames(path, topic)
        for camera, topic in found.cameras.items()
        if found.topics[topic] == ros2.IMAGE
    }
    original = Original(
        record,
        _document(found, PROVENANCE, Provenance),
        {key: _column(parts) for key, parts in found.columns.items()},
        events,
        frames,
        {
            key[1]: parts[0].unit
            for key, parts in found.columns.items()
            if key[1].startswith("streams/")
        },
        rate_hz,
        label,
        found.attached.get(LABEL_ARRAYS),
        sync,
    )
    return ForeignTrial(
        record.trial,
        path.name,
        events.get("events", lambda: iter(())),
        "the trial's time line",
        simulated=record.simulated,
        original=original,
        campaign=_campaign(path, found),
    )


def _json(found: _Found, name: str) -> Json:
    try:
        data = json.loads(found.attached[name].decode())
        json_text(data)  # no NaN, no infinity
    except (ValueError, RecursionError) as error:
        raise FormatError(f"has a damaged {name}: {error}") from None
    if not isinstance(data, dict):
        raise FormatError(f"has a damaged {name}: it is not an object")
    return data


def _document(found: _Found, name: str, kind: type[DocumentT]) -> DocumentT:
    try:
        return kind.parse(_json(found, name), Path(name))
    except (DocumentError, NewerFormat) as error:
        raise FormatError(f"has a damaged {error}") from None


def _campaign(path: Path, found: _Found) -> CampaignTexts:
    info: Any = _json(found, INFO)  # checked as far as it is used
    if not isinstance(info.get("name"), str) or not isinstance(info.get("simulated"), bool):
        raise FormatError(f"has a damaged {INFO}: it lacks name or simulated")
    texts = []
    for name in (PROTOCOL, RIG):
        try:
            texts.append(found.attached[name].decode())
            parse_yaml(texts[-1], path)
        except (ValueError, InputError) as error:
            raise FormatError(f"has a damaged {name}: {error}") from None
    return CampaignTexts(info, *texts)


def _column(parts: list[ros2.RowsMessage]) -> npt.NDArray[np.generic]:
    first = parts[0].values
    for part in parts:
        if part.values.dtype != first.dtype or part.values.shape[1:] != first.shape[1:]:
            raise FormatError(f"holds {part.column!r:.60} as rows of several kinds")
    return np.concatenate([part.values for part in parts])


def _our_events(path: Path, topic: str) -> Callable[[], Iterator[EventChunk]]:
    def read() -> Iterator[EventChunk]:
        for _, _, data in _messages(path, None, {ros2.EVENTS}, topic):
            packet = ros2.EventPacket.parse(ros2.Fields(data))
            t_ns, chunk = ros2.unpack_mono(packet)
            if np.any(t_ns % 1000):
                raise FormatError("holds events between two microseconds of their camera")
            yield _checked(chunk, packet)

    return read


def _our_frames(path: Path, topic: str) -> Callable[[], Iterator[U8]]:
    def read() -> Iterator[U8]:
        for _, _, data in _messages(path, None, {ros2.IMAGE}, topic):
            yield ros2.Image.parse(data).image

    return read


def _checked(chunk: EventChunk, packet: ros2.EventPacket) -> EventChunk:
    """Check events against the size that their packet gives."""
    size = packet.width, packet.height
    if 0 not in size and len(chunk) and (chunk.x.max() >= size[0] or chunk.y.max() >= size[1]):
        raise FormatError(f"holds events outside of the {size[0]} x {size[1]} pixels of its camera")
    return event_chunk(chunk.x, chunk.y, chunk.p, chunk.t_us)


def _source(path: Path, found: _Found, end: float = float("inf")) -> MessageSource:
    """Return the messages of a recording by other programs, read up to the byte `end`."""

    def read(topic: str) -> Iterator[bytes]:
        for _, _, data in _messages(path, None, {found.topics[topic]}, topic, _FileHead(end)):
            yield data

    return MessageSource(found.topics, read, frozenset(found.ros1))


def _check_library(path: Path) -> None:
    if util.find_spec("mcap") is None:
        raise ModuleNotFoundError("No module named 'mcap'", name="mcap")


MCAP = Format(
    suffixes=(".mcap",),
    sniff=lambda path, head: head.startswith(MAGIC),
    read=read_mcap,
    salvage=salvage_mcap,
    check=_check_library,
    publish=write_mcap,
    card=CARD,
)
