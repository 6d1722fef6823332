"""Reader of Prophesee's raw and dat files and of `.es`, through faery if it is installed.

It is an extra, `pip install 'sliplab[formats]'`. A file that ends within an event is refused as cut
short, which faery would not notice.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from importlib import import_module, util
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numba import njit

from sliplab.protocols.errors import InputError
from sliplab.storage.formats.foreign import (
    Damage,
    ForeignTrial,
    FormatError,
    check_pixels,
    event_chunk,
    read_head,
)
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import EventChunk

LIBRARY = "faery"
EVENT_STREAM = b"Event Stream"
"""First bytes of a `.es` file."""
_RAW = re.compile(rb"(?mi)^% (?:evt \d|format EVT\d)")
_DAT = re.compile(rb"(?mi)^% version \d")
_RAW_HEADER = re.compile(rb"(?:%[^\n]*\n)*%[^\n]*")
_VERSION = re.compile(rb"(?mi)^% (?:evt |format EVT)(\d)")
_HEADER_CUT = "is cut short in its header"
_MOST_LINE = 1 << 20
_ES_HEAD = len(EVENT_STREAM) + 4
"""Name, version in three bytes, and kind of events; the size follows."""
_ES_OVERFLOWS = {1: 0b1111_1110, 2: 0b1111_1100}
"""Of change and ATIS events: the first byte from which on time passes without an event."""
_NO_SIZE = (2048, 2048)
"""faery returns this where a file gives no size; its events' 11 bits reach no further."""
_BLOCK = 1 << 16
"""Bytes that faery reads at once."""
T = TypeVar("T")


def faery_type(head: bytes) -> str | None:
    """Return faery's name for the format of a file by its first bytes; None for any other."""
    if head.startswith(EVENT_STREAM):
        return "es"
    header = takewhile(lambda line: line.startswith(b"%"), head.split(b"\n"))
    lines = b"\n".join(header)
    if _RAW.search(lines):
        return "evt"
    return "dat" if _DAT.search(lines) else None


def read_by_faery(path: Path, name: str) -> ForeignTrial:
    """Read a `.raw`, `.dat` or `.es` file as a trial called `name`.

    Raises:
        InputError: faery is not installed.
        FormatError: the file says no format, is cut short, or faery cannot read it.
    """
    form = _form(path)
    begin = _begin(path, form)
    if rest := _rest(path, form, begin):
        raise Damage(_cut_short(rest))
    return _trial(path, name, form, None)


def salvage_by_faery(path: Path, name: str) -> ForeignTrial:
    """Read the events of a damaged file that stand before the damage.

    faery reads blocks of 64 KiB, and returns nothing of the one in which it stops.

    Raises:
        InputError: faery is not installed.
        FormatError: the file's header is damaged, or says no format.
    """
    form = _form(path)
    begin, size = _begin(path, form), path.stat().st_size
    rest = _rest(path, form, begin)
    reason = _cut_short(rest) if rest else None
    trial = _trial(path, name, form, None)
    packets: int | None = None
    count, at = 0, size - rest
    try:
        for chunk in trial.events():
            check_pixels(chunk, trial.event_px())
            count += len(chunk)
    except FormatError as error:
        packets = _whole_blocks(path, form)
        at, reason = begin + packets * _BLOCK, str(error)
        if at >= size:  # faery reads on: nobody knows where that is
            raise
    if reason is None:
        return trial
    lost = Lost(at_byte=at, unread_bytes=size - at, reason=reason)
    return replace(_trial(path, name, form, count), lost=lost, packets=packets)


def check_faery(path: Path) -> None:
    """Check that faery is there for a file. Raises InputError where it is not installed."""
    if util.find_spec(LIBRARY) is None:
        raise InputError(
            path, "", None,
            "needs the library faery, which is not installed; the extra 'formats' brings it: "
            "pip install 'sliplab[formats]'",
        )  # fmt: skip


def _form(path: Path) -> str:
    """Return faery's name for the format of a file."""
    check_faery(path)
    head = read_head(path)
    form = faery_type(head)
    if form is None:
        if EVENT_STREAM.startswith(head) or _RAW_HEADER.fullmatch(head):
            raise Damage(_HEADER_CUT)
        raise FormatError(
            "gives no format: a .raw file has a line `% evt 3.0` or `% format EVT3` in its header, "
            "a .dat file `% Version 2`, a .es file begins with `Event Stream`"
        )
    return form


def _begin(path: Path, form: str) -> int:
    """Return the byte at which the events of a file begin."""
    size = path.stat().st_size
    with path.open("rb") as file:
        if form == "es":
            kind = file.read(_ES_HEAD)[-1:]
            begin = _ES_HEAD + (0 if kind == b"\0" else 4)
        else:
            begin = 0
            while (line := file.readline(_MOST_LINE)).startswith(b"%") and _is_text(line):
                begin += len(line)
                if begin == size and not line.endswith(b"\n"):
                    raise Damage(_HEADER_CUT)
            begin += 2 if form == "dat" else 0  # kind and size of its events
    if begin > size:
        raise Damage(_HEADER_CUT)
    return begin


def _is_text(line: bytes) -> bool:
    """Return whether faery takes a line for one of the header, not for events."""
    try:
        line.decode()
    except UnicodeDecodeError:
        return False
    return True


def _rest(path: Path, form: str, begin: int) -> int:
    """Return the bytes at the end of a file that are too few for an event."""
    size = path.stat().st_size
    if form == "dat":
        return (size - begin) % 8
    if form == "evt":
        found = _VERSION.findall(read_head(path)[:begin])
        return (size - begin) % (4 if found and found[-1] == b"2" else 2)
    if size == begin:
        return 0
    with path.open("rb") as file:
        kind = file.read(_ES_HEAD)[-1]
    if kind not in _ES_OVERFLOWS:
        return 0
    content = np.memmap(path, np.uint8, "r", begin)
    return int(_es_rest(content, np.uint8(_ES_OVERFLOWS[kind])))


@njit(cache=True, nogil=True)
def _es_rest(content, overflow):  # type: ignore[no-untyped-def]
    """Return the bytes behind the last whole event: 5 bytes each, or 1 that lets time pass."""
    at = whole = 0
    while at < len(content):
        at += 1 if content[at] >= overflow else 5
        if at <= len(content):
            whole = at
    return len(content) - whole


def _whole_blocks(path: Path, form: str) -> int:
    """Return the number of blocks that faery reads before it stops."""
    decoder = getattr(import_module(f"{LIBRARY}.extension"), form).Decoder
    options = {"t0": 0} if form == "es" else {
        "dimensions_fallback": _NO_SIZE, "version_fallback": f"{form}2"
    }  # fmt: skip
    count = 0
    with suppress(FormatError), _guarded(lambda: decoder(path=path, **options), None, 0) as blocks:
        while _guarded(lambda: next(blocks, None), None, 0) is not None:
            count += 1
    return count


def _cut_short(rest: int) -> str:
    return f"is cut short: its last {rest} bytes are no whole event"


def _trial(path: Path, name: str, form: str, most: int | None) -> ForeignTrial:
    """Return a trial of the first `most` events of a file, of all by default."""

    def stream() -> Any:
        return import_module(LIBRARY).events_stream_from_file(
            path, dimensions_fallback=_NO_SIZE, file_type=form
        )

    width, height = _guarded(lambda: stream().dimensions(), None, 0)
    known = (int(width), int(height)) if (width, height) != _NO_SIZE else None

    def all_events() -> Iterator[EventChunk]:
        count = 0
        packets = _guarded(lambda: iter(stream()), known, count)
        while most is None or count < most:
            rows = _guarded(lambda: next(packets, None), known, count)
            if rows is None:
                break
            count += len(rows)
            yield event_chunk(rows["x"], rows["y"], rows["on"].view("u1"), rows["t"])

    return ForeignTrial(
        name, path.name, all_events, "the camera's own clock, us, from the file's beginning",
        lambda: known, about={"read_by": LIBRARY},
        unknown=("sync grade", "poses", "motion", "condition", "frames", "triggers"),
    )  # fmt: skip


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
