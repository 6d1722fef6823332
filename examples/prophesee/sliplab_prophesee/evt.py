"""Prophesee's event formats: RAW headers, EVT 3.0 and EVT 2.0 to events and triggers, and back.

A RAW stream is a header of lines that begin with ``%``, the last ``% end``, and little-endian
words. The four highest bits of a word are its type. EVT 3.0 sends what has changed only: 16-bit
words set the time (12 high bits, 12 low bits, 1 us), the row, and a column with its polarity, alone
or as the first of a vector of 12 or 8 pixels. EVT 2.0 has the column, the row and the 6 low bits of
the time in each word of 32 bits. Layouts: docs.prophesee.ai, Encoding Formats; times before the
first high part are unknown, and dropped, as the maker's decoders do.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import EventChunk

U16 = npt.NDArray[np.uint16]
U32 = npt.NDArray[np.uint32]
I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
MOST_HEADER = 1 << 20
ADDR_Y, ADDR_X, BASE_X, VECT_12, VECT_8 = 0x0, 0x2, 0x3, 0x4, 0x5
TIME_LOW, TIME_HIGH, EXT_TRIGGER = 0x6, 0x8, 0xA
_HIGHS = 1 << 12
"""EVT 3.0: values of the high part of the time, of 4096 us each, before it begins anew."""
_HIGHS_2 = 1 << 28
"""The same of EVT 2.0, of 64 us each."""


class FormatFault(ValueError):
    """Bytes are no stream of the format; the text says why."""


@dataclass(frozen=True)
class Header:
    """What a RAW header says.

    Attributes:
        evt: 2 or 3.
        size: columns and rows.
        serial: of the camera; empty where it is not said.
    """

    evt: int
    size: tuple[int, int]
    serial: str = ""

    @classmethod
    def parse(cls, text: bytes) -> Header:
        """Read the lines before ``% end``; of either style, old (`evt`) or new (`format`).

        Raises:
            FormatFault: no known format, or no size.
        """
        lines = text.decode("ascii", "replace").splitlines()
        said = dict(line[2:].split(" ", 1) for line in lines if line.count(" ") > 1)
        form = said.get("format", "")
        found = re.match(r"EVT(\d)", form) or re.match(r"(\d)\.0", said.get("evt", ""))
        if found is None or found[1] not in {"2", "3"} or form.startswith("EVT21"):
            raise FormatFault(f"the header names no format of EVT 2.0 and 3.0: {form or lines[:3]}")
        size = re.search(r"width=(\d+);height=(\d+)|height=(\d+);width=(\d+)", form)
        if size is not None:
            width, height = size[1] or size[4], size[2] or size[3]
        else:
            geometry = re.match(r"(\d+)x(\d+)", said.get("geometry", ""))
            if geometry is None:
                raise FormatFault("the header has neither `geometry WxH` nor a size in `format`")
            width, height = geometry[1], geometry[2]
        return cls(int(found[1]), (int(width), int(height)), said.get("serial_number", "").strip())

    def text(self) -> bytes:
        """Return the lines, with ``% end``."""
        width, height = self.size
        return (
            f"% evt {self.evt}.0\n% format EVT{self.evt};height={height};width={width}\n"
            f"% geometry {width}x{height}\n% serial_number {self.serial}\n% end\n"
        ).encode("ascii")


@dataclass(frozen=True)
class Decoded:
    """Events and edges of the trigger inputs, each in the order of the stream.

    Attributes:
        trigger_us, trigger_id, trigger_up: time, input, and True for a rising edge.
    """

    events: EventChunk
    trigger_us: I64
    trigger_id: I64
    trigger_up: Bool


class Decoder(Protocol):
    """A decoder of one stream, which keeps its state from call to call."""

    def decode(self, data: bytes) -> Decoded:
        """Decode the next bytes; a word that is cut is kept. Raises FormatFault."""


def decoder_of(header: Header) -> Decoder:
    """Return a decoder of a stream with that header."""
    return Evt3Decoder() if header.evt == 3 else Evt2Decoder()


class _Clock:
    """The high part of the time, counted on where it begins anew."""

    def __init__(self, values: int) -> None:
        self._values = values
        self.total: int | None = None
        """The last one; None before the first."""

    def follow(self, high: I64) -> I64:
        """Return values of the stream counted on, with `total` before them, (k + 1,).

        Raises:
            FormatFault: one is smaller than the one before, and not by as much as by a new turn.
        """
        assert self.total is not None
        before = np.concatenate([[self.total % self._values], high])
        step = np.diff(before)
        again = step < -self._values // 2
        if np.any((step < 0) & ~again):
            raise FormatFault("its clock fell back")
        counted: I64 = self.total + np.concatenate([[0], np.cumsum(step + again * self._values)])
        self.total = int(counted[-1])
        return counted


class Evt3Decoder:
    """A decoder of EVT 3.0."""

    def __init__(self) -> None:
        self._left = b""
        self._clock = _Clock(_HIGHS)
        self._state = np.array([TIME_LOW << 12, ADDR_Y << 12, BASE_X << 12], np.uint16)
        """Words that stand for what was sent before: low time, row, and base column."""

    def decode(self, data: bytes) -> Decoded:
        """Decode the next bytes. Raises FormatFault."""
        data = self._left + data
        whole = len(data) // 2 * 2
        words, self._left = np.frombuffer(data[:whole], "<u2"), data[whole:]
        kind = words >> 12
        if self._clock.total is None:
            highs = np.flatnonzero(kind == TIME_HIGH)
            if not len(highs):
                return _nothing()
            words = words[highs[0] :]
            self._clock.total = int(words[0] & 0xFFF)
        # the words that stand for the state come first: then every word has one before it
        words = np.concatenate([np.array([TIME_HIGH << 12], np.uint16), self._state, words])
        kind, value = words >> 12, (words & 0xFFF).astype(np.int64)
        high = kind == TIME_HIGH
        counted = self._clock.follow(value[high][1:])
        timed = _last(high | (kind == TIME_LOW))
        low = np.where(kind[timed] == TIME_LOW, value[timed], 0)
        t_us = (counted[np.cumsum(high) - 1] << 12) + low
        row = value[_last(kind == ADDR_Y)] & 0x7FF

        size = 12 * (kind == VECT_12) + 8 * (kind == VECT_8)
        passed = np.cumsum(size) - size
        base = _last(kind == BASE_X)
        column = (value[base] & 0x7FF) + passed - passed[base]
        alone = kind == ADDR_X
        column = np.where(alone, value & 0x7FF, column)
        up = np.where(alone, value, value[base]) >> 11
        valid = np.where(alone, 1, np.where(kind == VECT_8, value & 0xFF, value))
        carrying = np.flatnonzero(alone | (size > 0))
        bits = valid[carrying, None] >> np.arange(12) & 1
        which, bit = np.nonzero(bits)
        at = carrying[which]
        events = EventChunk(
            (column[at] + bit).astype(np.uint16),
            row[at].astype(np.uint16),
            up[at].astype(np.uint8),
            t_us[at],
        )

        reached = int((value[base[-1]] & 0x7FF) + passed[-1] + size[-1] - passed[base[-1]])
        polarity = int(value[base[-1]]) & 0x800
        self._state = np.array(
            [
                TIME_LOW << 12 | int(low[-1]),
                ADDR_Y << 12 | int(row[-1]),
                BASE_X << 12 | polarity | min(reached, 0x7FF),
            ],
            np.uint16,
        )
        triggered = kind == EXT_TRIGGER
        edge = value[triggered]
        return Decoded(events, t_us[triggered], edge >> 8, (edge & 1).astype(bool))


class Evt2Decoder:
    """A decoder of EVT 2.0."""

    def __init__(self) -> None:
        self._left = b""
        self._clock = _Clock(_HIGHS_2)

    def decode(self, data: bytes) -> Decoded:
        """Decode the next bytes. Raises FormatFault."""
        data = self._left + data
        whole = len(data) // 4 * 4
        words, self._left = np.frombuffer(data[:whole], "<u4"), data[whole:]
        if self._clock.total is None:
            highs = np.flatnonzero(words >> 28 == TIME_HIGH)
            if not len(highs):
                return _nothing()
            words = words[highs[0] :]
            self._clock.total = int(words[0] & (_HIGHS_2 - 1))
        kind, value = words >> 28, (words & (_HIGHS_2 - 1)).astype(np.int64)
        high = kind == TIME_HIGH
        counted = self._clock.follow(value[high])
        t_us = (counted[np.cumsum(high)] << 6) + (value >> 22)
        seen, triggered = kind < 2, kind == EXT_TRIGGER
        place, edge = value[seen], value[triggered]
        events = EventChunk(
            (place >> 11 & 0x7FF).astype(np.uint16),
            (place & 0x7FF).astype(np.uint16),
            kind[seen].astype(np.uint8),
            t_us[seen],
        )
        return Decoded(events, t_us[triggered], edge >> 8 & 0x1F, (edge & 1).astype(bool))


class Evt3Encoder:
    """An encoder of EVT 3.0, without vectors; times may lie anywhere, and are sent modulo 2^24 us.

    As a camera does, it sends the high part of the time whenever it changes, whether or not
    anything happens.
    """

    def __init__(self) -> None:
        self._high: int | None = None
        self._low = self._row = -1

    def encode(self, events: EventChunk, rising_us: I64, trigger: int = 0) -> bytes:
        """Return the words of events and rising edges of one trigger input, in order of time.

        Args:
            events: in order of time, none earlier than what was encoded before.
            rising_us: the same of edges.
        """
        n, m = len(events), len(rising_us)
        if not n + m:
            return b""
        t_us = np.concatenate([events.t_us, rising_us])
        first, last = int(t_us.min()) >> 12, int(t_us.max()) >> 12
        if self._high is None or first < self._high:  # or a clock that fell back
            self._high = first - 1
        ticks = np.arange(self._high + 1, last + 1, dtype=np.int64)
        self._high = last
        # a row each: turns of the high part, then edges, then events of the same time
        t_us = np.concatenate([ticks << 12, rising_us, events.t_us])
        order = np.argsort(t_us, kind="stable")
        sort = np.repeat([0, 1, 2], [len(ticks), m, n])[order]
        t_us = t_us[order]
        row = np.concatenate([np.full(len(ticks) + m, -1), events.y.astype(np.int64)])[order]
        column = np.concatenate(
            [
                np.zeros(len(ticks), np.int64),
                np.full(m, trigger << 8 | 1),
                events.x.astype(np.int64) | events.p.astype(np.int64) << 11,
            ]
        )[order]

        low = t_us & 0xFFF
        before = np.concatenate([[self._low], low[:-1]])
        anew = np.concatenate([[False], sort[:-1] == 0])  # the maker's decoders take 0 for it then
        words = np.zeros((len(t_us), 3), np.int64)
        words[:, 0] = TIME_LOW << 12 | low
        words[:, 1] = ADDR_Y << 12 | row
        words[:, 2] = np.choose(
            sort,
            [
                TIME_HIGH << 12 | (t_us >> 12 & 0xFFF),
                EXT_TRIGGER << 12 | column,
                ADDR_X << 12 | column,
            ],
        )
        happens, seen = sort > 0, sort == 2
        rows = row[seen]
        turned = np.concatenate([[self._row], rows[:-1]]) != rows
        sent = np.zeros(words.shape, bool)
        sent[:, 0] = happens & ((low != before) | anew)
        sent[np.flatnonzero(seen)[turned], 1] = True
        sent[:, 2] = True
        self._low = int(low[-1]) if happens[-1] else -1
        if len(rows):
            self._row = int(rows[-1])
        return words[sent].astype("<u2").tobytes()


def _last(mask: Bool) -> I64:
    """Return the index of the last True at or before each place; there is one."""
    index = np.where(mask, np.arange(len(mask)), 0)
    found: I64 = np.maximum.accumulate(index)
    return found


def _nothing() -> Decoded:
    none = np.empty(0, np.int64)
    return Decoded(EventChunk.empty(), none, none, np.empty(0, bool))
