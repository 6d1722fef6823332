"""Reader of Prophesee's `.raw` files (EVT 2.0, 2.1 and 3.0) and `.dat` files (versions 1 and 2).

A file is a header of lines that begin with `% `, and words. The header ends at `% end`, or at the
first line that is not text; the words are decoded in `evt`. Where this deviates from faery, which
tests compare it with, it follows the maker's documentation and decoders: events before the first
time are dropped; times that no event used change no later one; vectors start at their own base, and
one that reaches beyond the camera is damage; the clock begins again at 0 after a gap, too, and not
where it only fell; what follows `% end` is no header. Times are microseconds, with the header's
`T0` added, which faery writes.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.plugins.formats.evt import (
    DAT,
    EDGES,
    EVT2,
    EVT3,
    EVT21,
    FAULT,
    FELL,
    GOT,
    HAD,
    LAST_TURN_US,
    OUTSIDE,
    ROOM,
    Encoding,
    new_state,
    raised_warning,
)
from sliplab.storage.formats.foreign import OUTSIDE as EVENTS_OUTSIDE
from sliplab.storage.formats.foreign import (
    RISING,
    Damage,
    ForeignChunk,
    ForeignTrial,
    FormatError,
    Triggers,
    as_damage,
    empty_events,
    read_head,
)
from sliplab.storage.formats.format import Format
from sliplab.storage.schema.trial import Lost
from sliplab.storage.streams import I64, EventChunk

_LINES = re.compile(rb"(?:% [^\n]*\n?)+")
_FORMAT = re.compile(rb"(?mi)^% (?:evt \d|format EVT\d|version \d)")
_HEADER = re.compile(rb"(?:%[^\n]*\n)*%[^\n]*")
_HEADER_CUT = "is cut short in its header"
_MOST_LINE = 1 << 20
_NUMBER = re.compile(r"\d{1,20}", re.ASCII)
_MOST_SIDE = 1 << 16
_ENCODINGS = {"2": EVT2, "2.0": EVT2, "2.1": EVT21, "21": EVT21, "3": EVT3, "3.0": EVT3}
"""By the version after `evt` or `format EVT`."""
_DAT_BITS = {"1": (9, 8), "2": (14, 14), "2.0": (14, 14)}
"""Bits of columns and rows by version."""
_DAT_KINDS = (0x00, 0x0C)
"""Pixels with a polarity; 0x0E are triggers."""
_DAT_BYTES = 8
_FALLING = 2
"""A falling edge of the external input, as AEDAT4 numbers triggers."""
_CHUNK = 1 << 16
"""Events of a chunk."""
_EDGES = 1 << 10
_WORDS_A_FAULT = 1000
"""Words for each one that cannot be right and is left out; a file with more of them is damaged."""
_BLOCK = 1 << 18
"""Bytes that are read at once."""


@dataclass(frozen=True)
class Header:
    """Header of a file.

    Attributes:
        begin: byte of the first word; end: byte behind the last whole one.
        size: columns and rows; None if not stated.
        t0_us: what times count from.
        bits: of a column and a row, in DAT.
        swapped: EVT 2.1 with the upper half of each word first.
    """

    encoding: Encoding
    begin: int
    end: int
    size: tuple[int, int] | None
    t0_us: int
    bits: tuple[int, int] = (0, 0)
    swapped: bool = False


def is_prophesee(head: bytes) -> bool:
    """Return whether the first bytes of a file are those of a `.raw` or `.dat` file."""
    found = _LINES.match(head)
    return found is not None and bool(_FORMAT.search(found[0]))


def read_prophesee(path: Path, name: str) -> ForeignTrial:
    """Read a `.raw` or `.dat` file as a trial called `name`.

    Raises:
        FormatError: it says no format, or one that is not read.
        Damage: it is cut short.
    """
    header = read_header(path)
    if lost := _rest(path, header):
        raise Damage(lost.reason)
    return _trial(path, name, header)


def salvage_prophesee(path: Path, name: str) -> ForeignTrial:
    """Read the events of a damaged file before the damage.

    Raises:
        FormatError: the file's header is damaged, or says no format.
    """
    header = read_header(path)
    lost = _rest(path, header)
    try:
        for _ in _decoded(path, header):
            pass
    except DamagedWord as error:
        unread = path.stat().st_size - error.at_byte
        lost = Lost(at_byte=error.at_byte, unread_bytes=unread, reason=str(error))
        header = replace(header, end=error.at_byte)
    return replace(_trial(path, name, header), lost=lost)


class DamagedWord(Damage):
    """A word cannot be right.

    Attributes:
        at_byte: its place in the file.
    """

    def __init__(self, at_byte: int, reason: str) -> None:
        """Make one whose `reason` continues after "is damaged at byte N: "."""
        self.at_byte = at_byte
        super().__init__(f"is damaged at byte {at_byte}: {reason}")


def read_header(path: Path) -> Header:
    """Read the header of a `.raw` or `.dat` file.

    Raises:
        FormatError: it says no format, or one that is not read.
        Damage: it is cut short.
    """
    head = read_head(path)
    size = path.stat().st_size
    lines, begin = _lines(path, size)
    given = {key: value for words in lines for key, value in _values(words)}
    t0_us = int(given.get("t0", "0"))
    if t0_us >= LAST_TURN_US:
        raise FormatError(f"counts times from {t0_us} us, which is no time")
    if "evt" in given:
        encoding = _ENCODINGS.get(given["evt"])
        if encoding is None:
            raise FormatError(f"is of EVT {given['evt']}; read are EVT 2.0, 2.1 and 3.0")
        if given.get("endianness") == "big":
            raise FormatError("is big-endian; read are little-endian files")
        end = size - (size - begin) % np.dtype(encoding.dtype).itemsize
        swapped = encoding is EVT21 and given.get("endianness") == "legacy"
        return Header(encoding, begin, end, _size(given), t0_us, swapped=swapped)
    if "version" in given:
        bits = _dat_bits(path, begin, given["version"])
        begin += 2
        return Header(DAT, begin, size - (size - begin) % _DAT_BYTES, _size(given), t0_us, bits)
    if not head or _HEADER.fullmatch(head):
        raise Damage(_HEADER_CUT)
    raise FormatError(
        "gives no format: a .raw file has a line `% evt 3.0` or `% format EVT3` in its header, "
        "a .dat file `% Version 2`"
    )


def _dat_bits(path: Path, begin: int, version: str) -> tuple[int, int]:
    """Check version, kind and size of DAT's events, and return the bits of a column and a row."""
    bits = _DAT_BITS.get(version)
    if bits is None:
        raise FormatError(f"is of DAT version {version}; read are 1 and 2")
    with path.open("rb") as file:
        file.seek(begin)
        found = file.read(2)
    if len(found) < 2:
        raise Damage(_HEADER_CUT)
    if found[0] not in _DAT_KINDS or found[1] != _DAT_BYTES:
        raise FormatError(
            f"holds DAT events of type {found[0]} with {found[1]} bytes; read are types 0 and 12 "
            f"with {_DAT_BYTES}"
        )
    return bits


def _lines(path: Path, size: int) -> tuple[list[list[str]], int]:
    """Return the words of each line of a header, and the byte behind it."""
    lines, begin = [], 0
    with path.open("rb") as file:
        while (line := file.readline(_MOST_LINE)).startswith(b"% ") and _is_text(line):
            begin += len(line)
            if not line.endswith(b"\n"):
                if begin == size:
                    raise Damage(_HEADER_CUT)
                raise FormatError(f"has a line of more than {_MOST_LINE} bytes in its header")
            words = re.split(r"[ ;]+", line[2:].decode().strip())
            if words == ["end"]:
                break
            lines.append(words)
    return lines, begin


def _is_text(line: bytes) -> bool:
    """Return whether a line is one of a header, not of words that begin as one."""
    try:
        return line.decode().rstrip("\r\n").replace("\t", " ").isprintable()
    except UnicodeDecodeError:
        return False


def _values(words: list[str]) -> Iterator[tuple[str, str]]:
    """Yield what a line says, under names that are the same for all ways to say it.

    What is no number where one belongs is left out, as faery does.
    """
    key, value = words[0].lower(), words[1] if len(words) > 1 else ""
    number = _NUMBER.fullmatch(value)
    if key in {"evt", "version"} or (number and key in {"t0", "width", "height"}):
        yield key, value
    elif key == "geometry":
        width, _, height = value.partition("x")
        if _NUMBER.fullmatch(width) and _NUMBER.fullmatch(height):
            yield from (("width", width), ("height", height))
    elif key == "format" and value.lower().startswith("evt"):
        yield "evt", value[3:]
        for word in words[2:]:
            name, _, content = word.partition("=")
            if name == "endianness" or (name in {"width", "height"} and _NUMBER.fullmatch(content)):
                yield name, content


def _size(given: dict[str, str]) -> tuple[int, int] | None:
    width, height = int(given.get("width", "0")), int(given.get("height", "0"))
    return (width, height) if 0 < width < _MOST_SIDE and 0 < height < _MOST_SIDE else None


def _rest(path: Path, header: Header) -> Lost | None:
    """Return the bytes at the end of a file that are too few for a word."""
    rest = path.stat().st_size - header.end
    if not rest:
        return None
    reason = f"is cut short: its last {rest} bytes, from byte {header.end} on, are no whole event"
    return Lost(at_byte=header.end, unread_bytes=rest, reason=reason)


def _trial(path: Path, name: str, header: Header) -> ForeignTrial:
    """Return a trial of the words that a header describes."""
    with as_damage():
        triggers, left_out = _triggers(path, header)

    states: list[I64] = []

    def all_events() -> Iterator[EventChunk]:
        states[:] = [new_state(header.t0_us, *header.bits)]
        for chunk, _ in _decoded(path, header, states[0]):
            yield chunk

    unknown = ("sync grade", "poses", "motion", "condition", "frames")
    return ForeignTrial(
        name,
        path.name,
        all_events,
        "the camera's own clock, us, from the file's beginning",
        lambda: header.size,
        triggers,
        about={"encoding": header.encoding.name, "left_out": left_out},
        unknown=unknown if triggers is not None else (*unknown, "triggers"),
        notes=lambda: tuple(line for state in states for line in raised_warning(state)),
    )


def _triggers(path: Path, header: Header) -> tuple[Triggers | None, list[str]]:
    """Return the edges of the first trigger input that has some, and the names of others."""
    encoding = header.encoding
    if encoding.type_bit is None or not any(
        encoding.has_edges(words) for _, words in _blocks(path, header)
    ):
        return None, []
    edges = np.concatenate([found for _, found in _decoded(path, header)])
    return triggers_of(edges)


def triggers_of(edges: I64) -> tuple[Triggers | None, list[str]]:
    """Return the edges of the first trigger input, and the names of others.

    Args:
        edges: time (us), input, and 1 for a rising one, shape (n, 3).
    """
    inputs = np.unique(edges[:, 1])
    if not len(inputs):
        return None, []
    mine = edges[edges[:, 1] == inputs[0]]
    kind = np.where(mine[:, 2] == 1, RISING, _FALLING).astype(np.uint8)
    return Triggers(mine[:, 0].copy(), kind), [f"trigger input {one}" for one in inputs[1:]]


def _decoded(
    path: Path, header: Header, state: I64 | None = None
) -> Iterator[tuple[EventChunk, I64]]:
    """Yield events, and the edges of trigger inputs among them: time (us), input, 1 if rising.

    Args:
        state: before the first word, a new one by default; changed.

    Up to one in 1,000 words may be wrong: a pixel outside of the camera, and what it would add, is
    left out; times may run back where a high part fell.

    Raises:
        DamagedWord: after everything before it was yielded.
    """
    most = header.encoding.most_px
    width, height = header.size or (most, most)
    item = np.dtype(header.encoding.dtype).itemsize
    state = new_state(header.t0_us, *header.bits) if state is None else state
    edges = np.empty((_EDGES, 3), np.int64)
    chunk, filled = empty_events(_CHUNK), 0
    most_faults = (header.end - header.begin) // item // _WORDS_A_FAULT
    faults: list[DamagedWord] = []
    for place, words in _blocks(path, header):
        at = 0
        while at < len(words):
            at, filled = header.encoding.decode(
                words,
                at,
                filled,
                state,
                width,
                height,
                chunk.x,
                chunk.y,
                chunk.p,
                chunk.t_us,
                edges,
            )
            fault = int(state[FAULT])
            if fault or filled > _CHUNK - ROOM or state[EDGES] == _EDGES:
                yield chunk[:filled], edges[: state[EDGES]].copy()
                chunk, filled, state[EDGES] = empty_events(_CHUNK), 0, 0
            if fault:
                where = f"{width} x {height} pixels {'in its header' if header.size else 'of all'}"
                faults.append(DamagedWord(place + at * item, _reason(state, where)))
                if len(faults) > most_faults or fault not in {FELL, OUTSIDE}:
                    raise faults[0]
                words_out, events_out = header.encoding.after_fault(int(words[at]), state)
                at += words_out
                if events_out:
                    out = {EVENTS_OUTSIDE: events_out}
                    yield _left_out(out), edges[:0].copy()
    yield chunk[:filled], edges[: state[EDGES]].copy()


def _reason(state: I64, where: str) -> str:
    fault, got, had = (int(state[index]) for index in (FAULT, GOT, HAD))
    if fault == OUTSIDE:
        return f"an event at column {got}, row {had}, outside of the {where}"
    if fault == FELL:
        return f"the high part of the time falls from {had} to {got}"
    return "a time that is out of range"


def _blocks(path: Path, header: Header) -> Iterator[tuple[int, npt.NDArray[Any]]]:
    """Yield the words of a file, each block with its byte; one is valid until the next."""
    buffer = bytearray(_BLOCK)
    dtype = np.dtype(header.encoding.dtype)
    with path.open("rb") as file:
        file.seek(header.begin)
        at = header.begin
        while at < header.end:
            count = min(_BLOCK, header.end - at)
            if file.readinto(memoryview(buffer)[:count]) != count:
                raise Damage(f"became shorter while it was read, at byte {at}")
            words = np.frombuffer(buffer, dtype, count // dtype.itemsize)
            if header.swapped:
                words = words << np.uint64(32) | words >> np.uint64(32)
            yield at, words
            at += count


def _left_out(events: dict[str, int]) -> ForeignChunk:
    none = empty_events(0)
    return ForeignChunk(none.x, none.y, none.p, none.t_us, events)


RAW = Format(
    suffixes=(".raw", ".dat"),
    sniff=lambda path, head: is_prophesee(head),
    read=read_prophesee,
    salvage=salvage_prophesee,
)
