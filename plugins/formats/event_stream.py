"""Reader of `.es` files, through faery if it is installed.

It is an extra, `pip install 'sliplab[formats]'`. A file that ends within an event is refused as cut
short, which faery would not notice.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import import_module, util
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import (
    Damage,
    ForeignTrial,
    FormatError,
    event_chunk,
    read_head,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.kernels import njit
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import U8, EventChunk

LIBRARY = "faery"
EVENT_STREAM = b"Event Stream"
"""First bytes of a file."""
_HEAD = len(EVENT_STREAM) + 4
"""Name, version in three bytes, and kind of events; the size follows."""
_OVERFLOWS = {1: 0b1111_1110, 2: 0b1111_1100}
"""Of change and ATIS events: the first byte from which on time passes without an event."""
_BLOCK = 1 << 16
"""Bytes that faery reads at once."""
T = TypeVar("T")


def read_es(path: Path, name: str) -> ForeignTrial:
    """Read a file as a trial called `name`.

    Raises:
        InputError: faery is not installed.
        FormatError: the format is another, the file is truncated, or faery cannot read it.
    """
    begin = _begin(path)
    if rest := _rest(path, begin):
        raise Damage(_cut_short(rest))
    return _trial(path, name, None)


def salvage_es(path: Path, name: str) -> ForeignTrial:
    """Read the events of a damaged file before the damage.

    faery reads blocks of 64 KiB, and returns nothing of the one in which it stops.

    Raises:
        InputError: faery is not installed.
        FormatError: the file's header is damaged, or its format is another.
    """
    begin, size = _begin(path), path.stat().st_size
    rest = _rest(path, begin)
    reason = _cut_short(rest) if rest else None
    trial = _trial(path, name, None)
    packets: int | None = None
    count, at = 0, size - rest
    try:
        for chunk in trial.events():
            count += len(chunk)
    except FormatError as error:
        packets = _whole_blocks(path)
        at, reason = begin + packets * _BLOCK, str(error)
        if at >= size:  # faery reads ahead: the position is unknown
            raise
    if reason is None:
        return trial
    lost = Lost(at_byte=at, unread_bytes=size - at, reason=reason)
    return replace(_trial(path, name, count), lost=lost, packets=packets)


def check_faery(path: Path) -> None:
    """Check that faery is there for a file. Raises InputError where it is not installed."""
    if util.find_spec(LIBRARY) is None:
        raise InputError(
            path,
            "",
            None,
            "needs the library faery, which is not installed; the extra 'formats' brings it: "
            "pip install 'sliplab[formats]'",
        )


def _begin(path: Path) -> int:
    """Return the byte at which the events of a file begin."""
    check_faery(path)
    head = read_head(path)
    if not head.startswith(EVENT_STREAM):
        if EVENT_STREAM.startswith(head):
            raise Damage("is cut short in its header")
        raise FormatError("gives no format: a .es file begins with `Event Stream`")
    begin = _HEAD + (0 if head[_HEAD - 1 : _HEAD] == b"\0" else 4)
    if begin > len(head):
        raise Damage("is cut short in its header")
    return begin


def _rest(path: Path, begin: int) -> int:
    """Return the bytes at the end of a file that are too few for an event."""
    if path.stat().st_size == begin:
        return 0
    kind = read_head(path)[_HEAD - 1]
    if kind not in _OVERFLOWS:
        return 0
    content = np.memmap(path, np.uint8, "r", begin)
    return int(_rest_of(content, np.uint8(_OVERFLOWS[kind])))


@njit(cache=True, nogil=True)
def _rest_of(content: U8, overflow: np.uint8) -> int:
    """Return the bytes behind the last whole event: 5 bytes each, or 1 that lets time pass."""
    at = whole = 0
    while at < len(content):
        at += 1 if content[at] >= overflow else 5
        if at <= len(content):
            whole = at
    return len(content) - whole


def _whole_blocks(path: Path) -> int:
    """Return the number of blocks that faery reads before it stops."""
    decoder = import_module(f"{LIBRARY}.extension").es.Decoder
    count = 0
    with (
        suppress(FormatError),
        _guarded(lambda: decoder(path=path, t0=0), None, 0) as blocks,
    ):
        while _guarded(lambda: next(blocks, None), None, 0) is not None:
            count += 1
    return count


def _cut_short(rest: int) -> str:
    return f"is cut short: its last {rest} bytes are no whole event"


def _trial(path: Path, name: str, most: int | None) -> ForeignTrial:
    """Return a trial of the first `most` events of a file, of all by default."""

    def stream() -> Any:
        return import_module(LIBRARY).events_stream_from_file(path, file_type="es")

    width, height = _guarded(lambda: stream().dimensions(), None, 0)
    size = (int(width), int(height))

    def all_events() -> Iterator[EventChunk]:
        count = 0
        packets = _guarded(lambda: iter(stream()), size, count)
        while most is None or count < most:
            rows = _guarded(lambda: next(packets, None), size, count)
            if rows is None:
                break
            count += len(rows)
            yield event_chunk(rows["x"], rows["y"], rows["on"].view("u1"), rows["t"])

    return ForeignTrial(
        name,
        path.name,
        all_events,
        "the camera's own clock, us, from the file's beginning",
        lambda: size,
        about={"read_by": LIBRARY},
        unknown=("sync grade", "poses", "motion", "condition", "frames", "triggers"),
    )


def _guarded(step: Callable[[], T], size: tuple[int, int] | None, count: int) -> T:
    """Run a step in faery; a panic of its Rust code is no `Exception`."""
    try:
        return step()
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        text = " ".join(str(error).split()) or type(error).__name__
        text = re.sub(r'the stream "[^"]*"', "it", text)
        if "overflow" in text and size is not None:
            text += f": an event outside of the {size[0]} x {size[1]} pixels in its header"
        raise FormatError(
            "is damaged, truncated or not of the format in its header: after "
            f"{count:,} events faery stops with: {text}"
        ) from None


ES = Format(
    suffixes=(".es",),
    sniff=lambda path, head: head.startswith(EVENT_STREAM),
    read=read_es,
    salvage=salvage_es,
    check=check_faery,
)
