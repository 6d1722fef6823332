"""Trial of a recording of ROS 1 or ROS 2: the topics that are read, and those left out.

The first topic of events and the first one of frames that can be read are taken. A message that
cannot be right is left out and counted; other topics are named in the record.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Generator, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from sliplab.plugins.formats.prophesee import triggers_of
from sliplab.plugins.formats.ros.events import ARRAYS, PACKETS, EventDecoder
from sliplab.plugins.formats.ros.messages import IMAGE, Fields
from sliplab.plugins.formats.ros.pictures import COMPRESSED, PictureDecoder
from sliplab.storage.formats.foreign import ForeignTrial, FormatError
from sliplab.storage.streams import EventChunk, FrameChunk, Json

FRAMES = (IMAGE, COMPRESSED)
"""Types of messages with a frame."""
_TRIED = 100
"""Messages of a topic, one of which must be readable."""
_ZSTD, _MOST_MESSAGE = b"\x28\xb5\x2f\xfd", 1 << 28
"""First bytes of what zstd compressed, and the most bytes of a message."""
T_co = TypeVar("T_co", covariant=True)


@dataclass(frozen=True)
class MessageSource:
    """Messages of a recording.

    Attributes:
        topics: type of message by topic, as ROS 2 names it, in the order of the recording; empty
            where its messages are not serialised as ROS does.
        read: yields the messages of a topic, and an error for each that its file has lost; raises
            FormatError where all after it are lost.
        ros1: topics whose messages are serialised as in ROS 1.
        warnings: lines about the file.
    """

    topics: Mapping[str, str]
    read: Callable[[str], Iterator[bytes | FormatError]]
    ros1: Collection[str] = ()
    warnings: tuple[str, ...] = ()


class _Decoder(Protocol[T_co]):
    """Decoder of the messages of one topic, in their order."""

    def read(self, fields: Fields) -> T_co:
        """Return the content of a message. Raises FormatError if it is invalid."""

    def warnings(self) -> list[str]:
        """Return lines about what was left out or changed so far."""


D = TypeVar("D", bound=_Decoder[Any])


@dataclass
class _Topic(Generic[D]):
    """A topic, and its messages that the last read left out."""

    name: str
    source: MessageSource
    make: Callable[[], D]
    total: int = 0
    bad: int = 0
    reason: str = "holds no message"

    def __post_init__(self) -> None:
        self.decoder = self.make()

    def messages(self) -> Generator[Any, None, None]:
        """Yield the content of each message, and None for an invalid one."""
        self.total, self.bad, self.decoder = 0, 0, self.make()
        for data in self.source.read(self.name):
            self.total += 1
            try:
                found = self.decoder.read(Fields(_plain(data), ros1=self.name in self.source.ros1))
            except FormatError as error:
                self.reason = self.reason if self.bad else str(error)
                self.bad += 1
                found = None
            yield found

    def can_be_read(self) -> bool:
        """Return whether one of the first messages can be read; `reason` says why not."""
        with closing(self.messages()) as found:
            return any(item is not None for item in islice(found, _TRIED))

    def warnings(self) -> list[str]:
        """Return lines about what was left out or changed."""
        if not self.bad:
            return self.decoder.warnings()
        return [
            f"{self.bad:,} of {self.total:,} messages of {self.name} are left out; the first one "
            f"{self.reason}",
            *self.decoder.warnings(),
        ]


def _plain(data: bytes | FormatError) -> bytes:
    """Unpack a message that the recorder compressed, and raise one that was lost."""
    if isinstance(data, FormatError):
        raise data
    if not data.startswith(_ZSTD):
        return data
    import zstandard

    try:
        if not 0 < zstandard.frame_content_size(data) <= _MOST_MESSAGE:
            raise FormatError("holds a compressed message that does not state a fitting size")
        return bytes(zstandard.ZstdDecompressor().decompress(data))
    except zstandard.ZstdError as error:
        raise FormatError(f"holds a compressed message that is damaged: {error}") from None


def recording(path: Path, name: str, source: MessageSource) -> ForeignTrial:
    """Return the trial of a recording.

    Raises:
        FormatError: it is damaged, or no topic of events or frames in it can be read.
    """
    unread: dict[str, str] = {}
    events = _first(source, (*PACKETS, *ARRAYS), EventDecoder, unread)
    images = _first(source, (IMAGE,), PictureDecoder, unread)
    images = images or _first(source, (COMPRESSED,), PictureDecoder, unread)
    taken = [topic for topic in (events, images) if topic is not None]
    others = {name: source.topics[name] for name in sorted(source.topics)}
    for topic in taken:
        del others[topic.name]
    listed = ", ".join(
        f"{topic} ({kind or 'of an unknown type'}{unread.get(topic, '')})"
        for topic, kind in others.items()
    )
    if not taken:
        raise FormatError(
            "has no topic of events or frames that can be read; its topics are: "
            f"{listed or 'none'}"[:1000]
        )
    told = [*source.warnings, *([f"has topics that are not imported: {listed}"] if others else [])]
    about: Json = {"left_out": list(others)} if others else {}
    made: dict[str, Any] = {}
    if images is not None:
        first = next(_frames(images))
        made |= {
            "frames": lambda: _frames(images),
            "frame_px": (first.images.shape[2], first.images.shape[1]),
        }
        about |= {"frame_topic": images.name, "frame_encoding": images.decoder.encoding}
    if events is not None:
        made |= {"event_px": lambda: events.decoder.size}
        about |= _about_events(events)
        edges = _edges(events)
        if len(edges):
            made["triggers"], inputs = triggers_of(edges)
            about["left_out"] = [*about.get("left_out", ()), *inputs]
    return ForeignTrial(
        name,
        path.name,
        lambda: iter(()) if events is None else _events(events),
        _epoch(events),
        about=about,
        unknown=("sync grade", "poses", "motion", "condition"),
        notes=lambda: (*told, *(line for topic in taken for line in topic.warnings())),
        **made,
    )


def _first(
    source: MessageSource, kinds: Collection[str], make: Callable[[str], D], unread: dict[str, str]
) -> _Topic[D] | None:
    """Return the first topic of some types that can be read, and note why others cannot."""
    found = None
    for name, kind in source.topics.items():
        if kind not in kinds:
            continue
        topic = _Topic(name, source, lambda kind=kind: make(kind))  # type: ignore[misc]
        if found is not None:
            unread[name] = f", after {found.name}"
        elif topic.can_be_read():
            found = topic
        else:
            unread[name] = f", which {topic.reason}"
    return found


def _events(topic: _Topic[EventDecoder]) -> Iterator[EventChunk]:
    return (chunk for chunk in topic.messages() if chunk is not None)


def _frames(topic: _Topic[PictureDecoder]) -> Iterator[FrameChunk]:
    for number, found in enumerate(topic.messages()):
        if found is not None:
            t_ns, levels = found
            times = np.array([t_ns], np.int64)
            numbers = np.array([number], np.int64)
            yield FrameChunk(levels[None], numbers, times, times, np.zeros(1, np.uint8))


def _epoch(events: _Topic[EventDecoder] | None) -> str:
    if events is not None and events.decoder.encoding.startswith("evt3"):
        return "ROS time of the first packet, from there on the camera's own clock, us"
    return "ROS time, rounded to us"


def _about_events(events: _Topic[EventDecoder]) -> Json:
    encoding = events.decoder.encoding
    return {"event_topic": events.name, **({"encoding": encoding} if encoding else {})}


def _edges(topic: _Topic[EventDecoder]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return the edges of trigger inputs: time (us), input, 1 for a rising one."""
    found = [np.empty((0, 3), np.int64)]
    if topic.decoder.encoding.startswith("evt3"):
        found += [topic.decoder.edges for chunk in topic.messages() if chunk is not None]
    return np.concatenate(found)
