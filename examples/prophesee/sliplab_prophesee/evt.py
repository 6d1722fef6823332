"""Prophesee's event formats: RAW headers, EVT 3.0 and EVT 2.0 to events and triggers, and back.

A RAW stream is a header of lines that begin with ``%``, the last ``% end``, and little-endian
words; `sliplab.plugins.formats.evt` says what they mean. The fake sends EVT 3.0.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.plugins.formats.evt import EDGES, EVT2, EVT3, FAULT, OUTSIDE, ROOM, new_state
from sliplab.storage.formats.foreign import empty_events
from sliplab.storage.streams import EventChunk

I64 = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]
MOST_HEADER = 1 << 20
ADDR_Y, ADDR_X, TIME_LOW, TIME_HIGH, EXT_TRIGGER = 0x0, 0x2, 0x6, 0x8, 0xA
_ENCODINGS = {2: EVT2, 3: EVT3}
_MOST_EVENTS = 12
"""Events of a word: of the longest vector."""


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


class Decoder:
    """A decoder of one stream, which keeps its state from call to call.

    It decodes as the import of RAW files does; an event outside of the camera is left out.
    """

    def __init__(self, header: Header) -> None:
        self._encoding, self._size = _ENCODINGS[header.evt], header.size
        self._dtype = np.dtype(self._encoding.dtype)
        self._state, self._left = new_state(0), b""
        self.decode(b"")  # the kernel is compiled before the stream flows

    def decode(self, data: bytes) -> Decoded:
        """Decode the next bytes; a word that is cut is kept. Raises FormatFault."""
        data = self._left + data
        whole = len(data) - len(data) % self._dtype.itemsize
        self._left = data[whole:]
        words = np.frombuffer(bytearray(data[:whole]), self._dtype)
        chunk = empty_events(_MOST_EVENTS * len(words) + ROOM)
        edges = np.empty((len(words) + 1, 3), np.int64)
        columns = chunk.x, chunk.y, chunk.p, chunk.t_us, edges
        state, at, filled = self._state, 0, 0
        state[EDGES] = state[FAULT] = 0
        while True:
            at, filled = self._encoding.decode(words, at, filled, state, *self._size, *columns)
            if not state[FAULT]:
                break
            if state[FAULT] != OUTSIDE:
                raise FormatFault("its clock fell back")
            at += self._encoding.after_fault(int(words[at]), state)[0]
        t_us, which, rising = edges[: state[EDGES]].T
        return Decoded(chunk[:filled], t_us, which, rising == 1)


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
