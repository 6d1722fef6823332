"""Decoders of Prophesee's words: EVT 2.0, EVT 2.1, EVT 3.0 and DAT to events and trigger edges.

Layouts: docs.prophesee.ai, Encoding Formats and DAT File Format. A decoder takes words and its
state, fills columns, and stops in front of a word that cannot be right. Indices in its loop are
unsigned, which spares numba a test for negative ones. The higher part of an EVT
time is sent alone and grows until it begins again at 0. It may step back a little, and so may the
lower part, because events come from several sources; a high part that falls further is a fault. An
event has the time of the words before it, whatever times passed without an event, as in the maker's
own decoders. One that is earlier than the event before it is raised to that time, and counted; so
is one of DAT that is earlier by no more than a high part may step back. Events before the first
high part have no time, and are dropped, as the maker says for EVT 2.0; the row and the base of a
vector, which EVT 3.0 sends alone, count from the first word on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.formats.foreign import LATEST_US
from sliplab.storage.kernels import njit
from sliplab.storage.streams import I64, U8, U16

OUTSIDE, FELL, LATE = 1, 2, 3
"""Faults of a word: a pixel outside the camera, a high part that decreased, a time too late."""
(
    NOW,
    HIGH_US,
    HIGH,
    LOW,
    ROW,
    BASE,
    ON,
    EDGE_US,
    EDGES,
    X_BITS,
    Y_BITS,
    FAULT,
    GOT,
    HAD,
    RAISED,
    RAISED_US,
) = range(16)
"""Places in a state (int64).

NOW: time of the last event, us. HIGH_US: time of the last high part, with all turns of the clock
before it; HIGH: its value, -1 before the first. LOW: the low part of EVT 3.0, us. ROW, BASE, ON:
row, base column and polarity of the next vector. EDGE_US: time of the last edge; EDGES: rows filled
in the table of edges. X_BITS, Y_BITS: bits of DAT's columns and rows. FAULT: of the word at which
it stopped, or 0; GOT, HAD: its column and row, or its high part and the one before. RAISED: words
with events that were earlier than the event before them; RAISED_US: by at most how much.
"""
ROOM = 32
"""Rows that one word may fill."""
LAST_TURN_US = LATEST_US - (1 << 35)
"""Latest time at which a turn may begin; the longest turn has 2^34 us."""
_ADDR_Y, _ADDR_X, _BASE_X, _VECT_12, _VECT_8 = 0x0, 0x2, 0x3, 0x4, 0x5
_TIME_LOW, _TIME_HIGH, _EXT_TRIGGER = 0x6, 0x8, 0xA
_TILE = 1 << 11
"""Words of EVT 2.0 and DAT that are decoded together, and singly if one is out of the ordinary."""
_HIGHS_3, _HIGHS_2 = 1 << 12, 1 << 28
"""Values of the high part before it begins again: of 4096 us each in EVT 3.0, else of 64 us."""
_BACK = 10
"""Values by which a high part may step back."""

_BACK_US = _BACK << 12
"""Step back up to which an event of DAT is raised; one by more is a fault, and left as it is."""

Decode = Callable[..., tuple[int, int]]


@dataclass(frozen=True)
class Encoding:
    """An encoding of events.

    Attributes:
        dtype: of its words, little-endian. decode: see `decode_evt3`.
        type_bit: the lowest of the four bits with a word's type; None if all words are events.
        most_px: columns and rows that its words can encode.
        high_us: one of its high parts, us; 0 if it has none.
    """

    name: str
    dtype: str
    decode: Decode
    type_bit: int | None
    most_px: int
    high_us: int = 0

    def after_fault(self, word: int, state: I64) -> tuple[int, int]:
        """Make a state ready to continue after a fault; return words and events to leave out.

        Where a high part fell the clock restarted: the events behind it run back in time.
        """
        if state[FAULT] == FELL:
            state[HIGH_US] += (state[GOT] - state[HAD]) * self.high_us
            state[HIGH], state[LOW] = state[GOT], 0
            state[NOW] = state[EDGE_US] = state[HIGH_US]
            return 1, 0
        kind = None if self.type_bit is None else word >> self.type_bit
        if self.dtype == "<u2" and kind in (_VECT_12, _VECT_8):
            size = 12 if kind == _VECT_12 else 8
            state[BASE] += size
            return 1, (word & (1 << size) - 1).bit_count()
        if self.dtype == "<u8" and kind is not None:
            return 1, (word & 0xFFFFFFFF).bit_count()
        return 1, 1

    def has_edges(self, words: npt.NDArray[Any]) -> bool:
        """Return whether one of the words is an edge of a trigger input."""
        return self.type_bit is not None and bool(_any_edge(words, self.type_bit))


@njit(cache=True, nogil=True)
def _any_edge(words: npt.NDArray[Any], type_bit: int) -> bool:
    found = False
    for i in range(len(words)):
        found |= np.uint64(words[i]) >> np.uint64(type_bit) == _EXT_TRIGGER
    return found


def raised_warning(state: I64) -> list[str]:
    """Return a line about events that were earlier than those before them, if there were any."""
    if not state[RAISED]:
        return []
    return [
        f"{state[RAISED]:,} times of events step back, by up to {state[RAISED_US]:,} us: these "
        "events have the time of the event before them"
    ]


def new_state(t0_us: int, x_bits: int = 0, y_bits: int = 0) -> I64:
    """Return the state before the first word; times count from `t0_us`."""
    state = np.zeros(RAISED_US + 1, np.int64)
    state[[NOW, HIGH_US, EDGE_US, HIGH, X_BITS, Y_BITS]] = t0_us, t0_us, t0_us, -1, x_bits, y_bits
    return state


@njit(cache=True, nogil=True)
def _turned(value: int, high: int, high_us: int, highs: int, unit_us: int) -> tuple[int, int]:
    """Return the time of a new high part, us, and 0 or a fault.

    It begins again at 0 if it falls by half of its range or more. A step ahead by nearly all of it
    is a step back, too, over the place where it begins again.

    Args:
        high, high_us: the one before, -1 if there is none, and its time.
        highs: values of it; unit_us: of one.
    """
    if high < 0:
        return high_us + value * unit_us, 0
    step = value - high
    if step <= -highs // 2:
        step += highs
        if high_us >= LAST_TURN_US:
            return high_us, LATE
    if step >= highs - _BACK:
        step -= highs
    if step < -_BACK:
        return high_us, FELL
    return high_us + step * unit_us, 0


@njit(cache=True, nogil=True)
def _raised(at: int, now: int, state: I64) -> int:
    """Return the time of an event at a time, which is not before `now`."""
    if at < now:
        state[RAISED] += 1
        state[RAISED_US] = max(state[RAISED_US], now - at)
        return now
    return at


@njit(cache=True, nogil=True)
def _last_bit(valid: int) -> int:
    """Return the number of the highest bit that is set; there is one."""
    bit = 0
    while valid >> (bit + 1):
        bit += 1
    return bit


@njit(cache=True, nogil=True)
def decode_evt3(
    words: U16,
    at: int,
    filled: int,
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
    edges: I64,
) -> tuple[int, int]:
    """Decode 16-bit words; each changes the state: time, row, and columns alone or as vectors.

    A vector starts at the last base and advances it; a single event does not change it.

    Args:
        words: shape (n,). at: index of the first to decode.
        filled: rows that the columns hold already.
        state: see `new_state`. width, height: of the camera, pixels.
        x, y, p, t: columns of events to fill; t in us. edges: time (us), input, and 1 for a rising
            edge, shape (m, 3).

    Returns:
        Index of the first word not decoded, and rows filled. It stops at a fault, and where less
        than `ROOM` rows or no row of edges is left.
    """
    now, high_us, high, low = state[NOW], state[HIGH_US], state[HIGH], state[LOW]
    row, base, on, edge = state[ROW], state[BASE], state[ON], state[EDGES]
    fault = 0
    while at < len(words) and filled <= len(t) - ROOM and edge < len(edges):
        word = np.int64(words[np.uintp(at)])
        kind, value = word >> 12, word & 0xFFF
        if kind == _ADDR_X:
            column = value & 0x7FF
            if high >= 0:
                if column >= width or row >= height:
                    fault, state[GOT], state[HAD] = OUTSIDE, column, row
                    break
                now = _raised(high_us + low, now, state)
                to = np.uintp(filled)
                x[to], y[to], p[to], t[to] = column, row, value >> 11, now
                filled += 1
        elif kind == _ADDR_Y:
            row = value & 0x7FF
        elif kind == _TIME_LOW:
            low = value
        elif kind in (_VECT_12, _VECT_8):
            size = 12 if kind == _VECT_12 else 8
            valid: Any = value & ((1 << size) - 1)
            if valid and high >= 0:
                last = _last_bit(valid)
                if base + last >= width or row >= height:
                    fault, state[GOT], state[HAD] = OUTSIDE, base + last, row
                    break
                now = _raised(high_us + low, now, state)
                for bit in range(last + 1):  # without a branch: bits are hard to foresee
                    to = np.uintp(filled)
                    x[to], y[to], p[to], t[to] = base + bit, row, on, now
                    filled += valid >> bit & 1
            base += size
        elif kind == _BASE_X:
            base, on = value & 0x7FF, value >> 11
        elif kind == _TIME_HIGH:
            if value != high:
                found, fault = _turned(value, high, high_us, _HIGHS_3, 4096)
                if fault:
                    state[GOT], state[HAD] = value, high
                    break
                high, high_us, low = value, found, 0
        elif kind == _EXT_TRIGGER and high >= 0:
            state[EDGE_US] = max(state[EDGE_US], high_us + low)
            edges[edge, 0], edges[edge, 1] = state[EDGE_US], value >> 8
            edges[edge, 2] = value & 1
            edge += 1
        at += 1
    state[NOW], state[HIGH_US], state[HIGH], state[LOW] = now, high_us, high, low
    state[ROW], state[BASE], state[ON], state[EDGES] = row, base, on, edge
    state[FAULT] = fault
    return at, filled


@njit(cache=True, nogil=True)
def decode_evt2(
    words: npt.NDArray[np.uint32],
    at: int,
    filled: int,
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
    edges: I64,
) -> tuple[int, int]:
    """Decode 32-bit words, each with a pixel and 6 bits of time; otherwise as `decode_evt3`."""
    state[FAULT] = 0
    while at < len(words) and filled <= len(t) - ROOM and state[EDGES] < len(edges):
        end = at + min(_TILE, len(words) - at, len(t) - filled)
        count = _plain_evt2(
            words[at:end], state, width, height, x[filled:], y[filled:], p[filled:], t[filled:]
        )
        if count >= 0:
            at, filled = end, filled + count
            continue
        at, filled = _each_evt2(words[:end], at, filled, state, width, height, x, y, p, t, edges)
        if state[FAULT]:
            break
    return at, filled


@njit(cache=True, nogil=True)
def _plain_evt2(
    words: npt.NDArray[np.uint32],
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
) -> int:
    """Decode events and high parts, without a branch: which comes next is hard to foresee.

    Returns:
        Rows filled; -1, and the state as it was, where a word is of another kind or a fault, a time
        falls or the clock begins again at 0.
    """
    high_us, high = state[HIGH_US], state[HIGH]
    odd = high < 0
    filled: Any = 0
    for i in range(len(words)):
        word = np.int64(words[i])
        kind, value = word >> 28, word & (_HIGHS_2 - 1)
        seen = kind <= 1
        step = value - high
        odd |= (not seen) & ((kind != _TIME_HIGH) | (step < 0) | (step >= _HIGHS_2 - _BACK))
        high_us = high_us if seen else high_us + (step << 6)
        high = high if seen else value
        to = np.uintp(filled)
        x[to], y[to], p[to] = value >> 11 & 0x7FF, value & 0x7FF, kind
        t[to] = high_us + (value >> 22)
        filled += seen
    most_x = most_y = np.uint16(0)
    for i in range(filled):
        most_x, most_y = max(most_x, x[i]), max(most_y, y[i])
    for i in range(1, filled):
        odd |= t[i] < t[i - 1]
    if odd or most_x >= width or most_y >= height or (filled and t[0] < state[NOW]):
        return -1
    state[HIGH_US], state[HIGH] = high_us, high
    if filled:
        state[NOW] = t[filled - 1]
    return filled


@njit(cache=True, nogil=True)
def _each_evt2(
    words: npt.NDArray[np.uint32],
    at: int,
    filled: int,
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
    edges: I64,
) -> tuple[int, int]:
    """Decode words of EVT 2.0 of any kind, one by one."""
    now, high_us, high, edge = state[NOW], state[HIGH_US], state[HIGH], state[EDGES]
    fault = 0
    while at < len(words) and filled <= len(t) - ROOM and edge < len(edges):
        word = np.int64(words[np.uintp(at)])
        kind, value = word >> 28, word & (_HIGHS_2 - 1)
        if kind <= 1:
            if high >= 0:
                column, row = value >> 11 & 0x7FF, value & 0x7FF
                if column >= width or row >= height:
                    fault, state[GOT], state[HAD] = OUTSIDE, column, row
                    break
                now = _raised(high_us + (value >> 22), now, state)
                to = np.uintp(filled)
                x[to], y[to], p[to], t[to] = column, row, kind, now
                filled += 1
        elif kind == _TIME_HIGH:
            found, fault = _turned(value, high, high_us, _HIGHS_2, 64)
            if fault:
                state[GOT], state[HAD] = value, high
                break
            high, high_us = value, found
        elif kind == _EXT_TRIGGER and high >= 0:
            state[EDGE_US] = max(state[EDGE_US], high_us + (value >> 22))
            edges[edge, 0], edges[edge, 1] = state[EDGE_US], value >> 8 & 0x1F
            edges[edge, 2] = value & 1
            edge += 1
        at += 1
    state[NOW], state[HIGH_US], state[HIGH], state[EDGES] = now, high_us, high, edge
    state[FAULT] = fault
    return at, filled


@njit(cache=True, nogil=True)
def decode_evt21(
    words: npt.NDArray[np.uint64],
    at: int,
    filled: int,
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
    edges: I64,
) -> tuple[int, int]:
    """Decode 64-bit words: one of EVT 2.0, and 32 bits that say which pixels from its column on."""
    now, high_us, high, edge = state[NOW], state[HIGH_US], state[HIGH], state[EDGES]
    fault = 0
    while at < len(words) and filled <= len(t) - ROOM and edge < len(edges):
        word = np.int64(words[np.uintp(at)] >> np.uint64(32))
        valid: Any = np.int64(words[np.uintp(at)] & np.uint64(0xFFFFFFFF))
        kind, value = word >> 28, word & (_HIGHS_2 - 1)
        if kind == _TIME_HIGH:
            found, fault = _turned(value, high, high_us, _HIGHS_2, 64)
            if fault:
                state[GOT], state[HAD] = value, high
                break
            high, high_us = value, found
        elif kind <= 1 and valid and high >= 0:
            base, row, last = value >> 11 & 0x7FF, value & 0x7FF, _last_bit(valid)
            if base + last >= width or row >= height:
                fault, state[GOT], state[HAD] = OUTSIDE, base + last, row
                break
            now = _raised(high_us + (value >> 22), now, state)
            for bit in range(last + 1):
                to = np.uintp(filled)
                x[to], y[to], p[to], t[to] = base + bit, row, kind, now
                filled += valid >> bit & 1
        elif kind == _EXT_TRIGGER and high >= 0:
            state[EDGE_US] = max(state[EDGE_US], high_us + (value >> 22))
            edges[edge, 0], edges[edge, 1] = state[EDGE_US], value >> 8 & 0x1F
            edges[edge, 2] = value & 1
            edge += 1
        at += 1
    state[NOW], state[HIGH_US], state[HIGH], state[EDGES] = now, high_us, high, edge
    state[FAULT] = fault
    return at, filled


@njit(cache=True, nogil=True)
def decode_dat(
    words: npt.NDArray[np.uint64],
    at: int,
    filled: int,
    state: I64,
    width: int,
    height: int,
    x: U16,
    y: U16,
    p: U8,
    t: I64,
    edges: I64,
) -> tuple[int, int]:
    """Decode 64-bit words: 32 bits of time, column, row, and 4 bits above, 0 of an OFF event.

    A time that falls by more than half of its range has begun again at 0.
    """
    x_bits, y_bits = state[X_BITS], state[Y_BITS]
    state[FAULT] = 0
    while at < len(words) and filled < len(t):
        count = min(_TILE, len(words) - at, len(t) - filled)
        part = words[at : at + count]
        xs, ys = x[filled : filled + count], y[filled : filled + count]
        ps, ts = p[filled : filled + count], t[filled : filled + count]
        most_x, most_y = _split_places(part, x_bits, y_bits, xs, ys)
        falls = _split_times(part, x_bits + y_bits, state[HIGH_US], ps, ts)
        done = count
        if falls or ts[0] < state[NOW] or most_x >= width or most_y >= height:
            done = _mend(xs, ys, ts, state, width, height)
        if done:
            state[NOW] = ts[done - 1]
        at += done
        filled += done
        if state[FAULT]:
            break
    return at, filled


@njit(cache=True, nogil=True)
def _split_places(
    words: npt.NDArray[np.uint64], x_bits: int, y_bits: int, x: U16, y: U16
) -> tuple[np.uint16, np.uint16]:
    """Fill columns and rows, without a branch in the loop; return the largest of each."""
    most_x = most_y = np.uint16(0)
    for i in range(len(words)):
        x[i] = column = np.uint16(words[i] >> np.uint64(32) & np.uint64((1 << x_bits) - 1))
        y[i] = row = np.uint16(words[i] >> np.uint64(32 + x_bits) & np.uint64((1 << y_bits) - 1))
        most_x, most_y = max(most_x, column), max(most_y, row)
    return most_x, most_y


@njit(cache=True, nogil=True)
def _split_times(
    words: npt.NDArray[np.uint64], place_bits: int, turns_us: int, p: U8, t: I64
) -> bool:
    """Fill polarities and times, the latter after `turns_us`; return whether a time falls."""
    for i in range(len(words)):
        p[i] = words[i] >> np.uint64(32 + place_bits) & np.uint64(0xF) != 0
        t[i] = turns_us + np.int64(words[i] & np.uint64(0xFFFFFFFF))
    falls = False
    for i in range(1, len(words)):
        falls |= t[i] < t[i - 1]
    return falls


@njit(cache=True, nogil=True)
def _mend(x: U16, y: U16, t: I64, state: I64, width: int, height: int) -> int:
    """Raise times that fall, count turns of the clock, and stop at a fault; return rows before."""
    now, turned_us = state[NOW], 0
    for i in range(len(t)):
        if x[i] >= width or y[i] >= height:
            state[FAULT], state[GOT], state[HAD] = OUTSIDE, x[i], y[i]
            return i
        if now - (t[i] + turned_us) > 1 << 31:
            if state[HIGH_US] >= LAST_TURN_US:
                state[FAULT] = LATE
                return i
            turned_us += 1 << 32
            state[HIGH_US] += 1 << 32
        found = t[i] + turned_us
        t[i] = now = found if now - found > _BACK_US else _raised(found, now, state)
    return len(t)


EVT2 = Encoding("EVT 2.0", "<u4", decode_evt2, 28, 1 << 11, 64)
EVT21 = Encoding("EVT 2.1", "<u8", decode_evt21, 60, 1 << 11, 64)
EVT3 = Encoding("EVT 3.0", "<u2", decode_evt3, 12, 1 << 11, 4096)
DAT = Encoding("DAT", "<u8", decode_dat, None, 1 << 14)
