"""Events in messages that the drivers of event cameras publish under ROS 1 and ROS 2.

A packet of event_camera_msgs is encoded as ``mono``, ``libcaer``, ``libcaer_cmp`` or ``evt3``;
layouts: the README files of event_camera_msgs and event_camera_codecs, and the tokens of
libcaer_driver. An array of dvs_msgs or prophesee_event_msgs lists its events one by one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.plugins.formats.evt import (
    EDGES,
    EVT3,
    FAULT,
    FELL,
    HAD,
    HIGH,
    NOW,
    ROOM,
    ROW,
    new_state,
    raised_warning,
)
from sliplab.plugins.formats.evt import OUTSIDE as PLACE
from sliplab.plugins.formats.ros.messages import EVENTS, MONO, EventPacket, Fields, unpack_mono
from sliplab.storage.formats.foreign import OUTSIDE, ForeignChunk, FormatError
from sliplab.storage.kernels import njit
from sliplab.storage.streams import I64, U8, U16, EventChunk

PACKETS = (EVENTS, "event_array_msgs/msg/EventArray")
"""Types of messages with encoded events; the second is the former name of the first."""
ARRAYS = ("dvs_msgs/msg/EventArray", "prophesee_event_msgs/msg/EventArray")
"""Types of messages with a list of events."""
_EVT3, _LIBCAER, _LIBCAER_CMP = "evt3", "libcaer", "libcaer_cmp"
_MISLABELLED = "evt3, called libcaer_cmp"
_WORDS = {MONO: "u8", _LIBCAER: "u4", _LIBCAER_CMP: "u2", _EVT3: "u2"}
"""Words of each encoding."""
ENCODINGS = tuple(_WORDS)
_EVT3_HIGH, _NO_ROW = 0x8, (1 << 11) - 1
"""Type of a word with the high part of a time, and a row that no camera has."""
_LATE = 2
"""Packets by which one may come late; of more its driver was started again."""
_ROOM = 12
"""Events that a word of 16 bits may hold."""
_ROS1_EVENT = np.dtype([("x", "<u2"), ("y", "<u2"), ("s", "<u4"), ("ns", "<u4"), ("p", "u1")])
_ROS2_EVENT = np.dtype(
    {
        "names": ["x", "y", "s", "ns", "p"],
        "formats": ["<u2", "<u2", "<i4", "<u4", "u1"],
        "offsets": [0, 2, 6, 10, 14],
        "itemsize": 16,
    }
)
"""An event but the first, whose column and row are two bytes later: CDR aligns each field."""
_TIME_HIGH, _TIME_LOW, _ADDR_X, _ADDR_Y, _BASE_Y, _VECT_8 = range(6)
_LOWS, _HIGHS, _DRIVER_HIGHS = 1 << 12, 1 << 12, 1 << 4


class _OutOfOrder(FormatError):
    """A packet comes twice, or behind a later one."""


class EventDecoder:
    """Decoder of the messages of one topic, in their order.

    Attributes:
        size: columns and rows of the camera, None until a message gave it.
        encoding: of the packets; empty for arrays.
        edges: of trigger inputs in the last packet: time (us), input, 1 for a rising edge.

    Args:
        kind: type of the messages, one of `PACKETS` and `ARRAYS`.
    """

    def __init__(self, kind: str) -> None:
        self._array = kind in ARRAYS
        self._evt3 = new_state(0)
        self._lost = False
        self._offset_us: int | None = None
        self._last: tuple[int, bytes] | None = None
        self.size: tuple[int, int] | None = None
        self.encoding = ""
        self.edges = np.empty((0, 3), np.int64)

    def read(self, fields: Fields) -> EventChunk:
        """Return the events of a message; times in us.

        Raises:
            FormatError: it is damaged, or of an unknown encoding.
        """
        self.edges = self.edges[:0]
        try:
            return self._events(fields)
        except _OutOfOrder:
            raise
        except FormatError:
            self._lost = True
            raise

    def _events(self, fields: Fields) -> EventChunk:
        if self._array:
            height, width = fields.number("I"), fields.number("I")
            found = _listed(fields)
        else:
            packet = EventPacket.parse(fields)
            height, width = packet.height, packet.width
            found = self._unpacked(packet)
        if width and height:
            self.size = self.size or (width, height)
        return found

    def warnings(self) -> list[str]:
        """Return lines about events that were changed."""
        found = raised_warning(self._evt3)
        if self.encoding == _MISLABELLED:
            found.append("its packets are called libcaer_cmp and hold words of evt3: read as such")
        return found

    def _unpacked(self, packet: EventPacket) -> EventChunk:
        encoding = packet.encoding
        if encoding not in ENCODINGS:
            raise FormatError(
                f"holds events encoded as {encoding!r:.40}; read are {', '.join(ENCODINGS)}"
            )
        words = _words(packet, _WORDS[encoding])
        if encoding == _LIBCAER_CMP and (_begins_as_evt3(words) or self.encoding == _MISLABELLED):
            encoding = _MISLABELLED
        if self.encoding not in ("", encoding):
            raise FormatError(f"holds events encoded as {encoding!r} behind {self.encoding!r}")
        self.encoding = encoding
        if encoding == MONO:
            return unpack_mono(packet)[1]
        if encoding == _LIBCAER:
            return _unpack_libcaer(packet, words)
        if encoding == _LIBCAER_CMP:
            return _unpack_libcaer_cmp(packet, words)
        self._follow(packet)
        return self._unpack_evt3(packet, words)

    def _follow(self, packet: EventPacket) -> None:
        """Note a lost packet: what follows it counts on the time and row that it had.

        Raises:
            _OutOfOrder: it comes twice, or behind a later one.
        """
        data = bytes(packet.data)
        if self._last is not None:
            number, before = self._last
            if packet.seq == number and data == before and data:
                raise _OutOfOrder(f"holds packet {number} twice")
            if number - _LATE <= packet.seq < number:
                raise _OutOfOrder(f"holds packet {packet.seq} behind packet {number}")
            self._lost |= packet.seq not in {number, number + 1}
        self._last = packet.seq, data

    def _unpack_evt3(self, packet: EventPacket, words: npt.NDArray[np.uint16]) -> EventChunk:
        """Decode words of EVT 3.0, whose clock begins at the stamp of the first message."""
        state, at, filled = self._evt3, 0, 0
        x, y, p, times = _room(_ROOM * len(words) + ROOM)
        edges = np.empty((len(words) + 1, 3), np.int64)
        width, height = packet.width or EVT3.most_px, packet.height or EVT3.most_px
        state[EDGES] = outside = 0
        if self._lost:
            highs = np.flatnonzero(words >> 12 == _EVT3_HIGH)
            if not len(highs):  # when these events were is not known
                return EventChunk(x[:0], y[:0], p[:0], times[:0])
            at, self._lost, state[ROW] = int(highs[0]), False, _NO_ROW
        while at < len(words):
            at, filled = EVT3.decode(words, at, filled, state, width, height, x, y, p, times, edges)
            if state[FAULT] in {PLACE, FELL}:  # after a restart the import takes the longer part
                words_out, events_out = EVT3.after_fault(int(words[at]), state)
                outside += events_out if state[HAD] != _NO_ROW else 0
                at += words_out
            elif state[FAULT]:
                raise FormatError("holds events at a time that is out of range")
        if self._offset_us is None and state[HIGH] >= 0:
            first = int(times[0]) if filled else int(state[NOW])
            self._offset_us = packet.t_ns // 1000 - first if packet.t_ns else 0
        offset_us = self._offset_us or 0
        self.edges = edges[: state[EDGES]] + np.array([offset_us, 0, 0])
        left_out = {OUTSIDE: int(outside)} if outside else {}
        return ForeignChunk(
            x[:filled], y[:filled], p[:filled], times[:filled] + offset_us, left_out
        )


def _room(count: int) -> tuple[Any, Any, Any, I64]:
    """Return columns to fill: of columns, rows, polarities and times."""
    kinds = (np.uint16, np.uint16, np.uint8)
    x, y, p = (np.empty(count, kind) for kind in kinds)
    return x, y, p, np.empty(count, np.int64)


def _words(packet: EventPacket, kind: str) -> npt.NDArray[Any]:
    dtype = np.dtype((">" if packet.big_endian else "<") + kind)
    if len(packet.data) % dtype.itemsize:
        raise FormatError(f"holds a packet of {len(packet.data)} bytes, which ends within a word")
    words: npt.NDArray[Any] = np.frombuffer(packet.data, dtype)
    return words.astype(dtype.newbyteorder("="), copy=False)


def _begins_as_evt3(words: npt.NDArray[np.uint16]) -> bool:
    """Return whether the first word is a time of EVT 3.0, a type that libcaer_cmp has not."""
    return len(words) > 0 and words[0] >> 12 == _EVT3_HIGH


def _base_ns(packet: EventPacket) -> int:
    if packet.time_base >= 1 << 62:
        raise FormatError(f"holds events at {packet.time_base} ns, which is no time")
    return packet.time_base


def _unpack_libcaer(packet: EventPacket, words: npt.NDArray[np.uint32]) -> EventChunk:
    """Decode pairs of 32 bits: pixel and polarity, and us after the base with 31 bits."""
    if len(words) % 2:
        raise FormatError(f"holds a packet of {len(packet.data)} bytes, which ends within an event")
    places, times = words[::2], (words[1::2] & 0x7FFFFFFF).astype(np.int64)
    turns = np.cumsum(np.diff(times, prepend=times[:1]) < 0)  # they only grow within a packet
    t_ns = _base_ns(packet) + (times + (turns << 31)) * 1000
    return EventChunk(
        (places >> 17).astype(np.uint16),
        (places >> 2 & 0x7FFF).astype(np.uint16),
        (places >> 1 & 1).astype(np.uint8),
        (t_ns + 500) // 1000,
    )


def _unpack_libcaer_cmp(packet: EventPacket, words: npt.NDArray[np.uint16]) -> EventChunk:
    """Decode words of 4 bits of type and 12 of content, us after the base.

    They say what changed: the high and the low part of the time, the column, and rows alone or as
    8 bits from a base on.
    """
    if len(words) and int(words.max()) >> 12 > _VECT_8:
        raise FormatError(f"holds the word {int(words.max()):#06x}, which is none of libcaer_cmp")
    x, y, p, times = _room(8 * len(words))
    filled = _decode_libcaer_cmp(words, x, y, p, times)
    t_ns = _base_ns(packet) + times[:filled] * 1000
    return EventChunk(x[:filled], y[:filled], p[:filled], (t_ns + 500) // 1000)


@njit(cache=True, nogil=True)
def _decode_libcaer_cmp(words: U16, x: U16, y: U16, p: U8, t: I64) -> int:
    """Fill the columns; return the rows filled.

    libcaer_driver writes 4 of the 12 bits of the high part, and no word where it changes from one
    of the camera's packets to the next within a message: a part that falls has begun again at 0.
    """
    turns_us = high = low = carry_us = column = row = on = 0
    higher = True
    filled = 0
    for i in range(len(words)):
        word: Any = np.int64(words[i])
        kind, value = word >> 12, word & 0xFFF
        if kind == _TIME_HIGH:
            if value < high:
                turns_us += (_DRIVER_HIGHS if high < _DRIVER_HIGHS else _HIGHS) * _LOWS
            high, carry_us, higher = value, 0, True
        elif kind == _TIME_LOW:
            if low - value > _LOWS // 2 and not higher:
                carry_us += _LOWS
            low, higher = value, False
        elif kind == _ADDR_X:
            column = value & 0x7FF
        elif kind == _ADDR_Y:
            x[filled], y[filled], p[filled] = column, value & 0x7FF, value >> 11
            t[filled] = turns_us + high * _LOWS + low + carry_us
            filled += 1
        elif kind == _BASE_Y:
            row, on = value & 0x7FF, value >> 11
        elif kind == _VECT_8:
            for bit in range(8):
                if value >> bit & 1:
                    x[filled], y[filled], p[filled] = column, row + bit, on
                    t[filled] = turns_us + high * _LOWS + low + carry_us
                    filled += 1
            row += 8
    return filled


def _listed(fields: Fields) -> EventChunk:
    """Read a list of events, each with its own time."""
    count, data = fields.number("I"), fields.rest()
    size = 13 * count if fields.ros1 else 16 * count - 3 if count else 0
    if len(data) < size:
        raise FormatError("holds a message that is cut short")
    if fields.ros1:
        rows = np.frombuffer(data, _ROS1_EVENT, count)
    else:
        shifted = np.zeros(16 * count, np.uint8)
        shifted[2 : 2 + size] = np.frombuffer(data, np.uint8, size)
        rows = shifted.view(_ROS2_EVENT)
        if count:
            rows["x"][0], rows["y"][0] = np.frombuffer(data, "<u2", 2)
    t_ns = rows["s"].astype(np.int64) * 1_000_000_000 + rows["ns"]
    return EventChunk(
        rows["x"].astype(np.uint16),
        rows["y"].astype(np.uint16),
        (rows["p"] != 0).astype(np.uint8),
        (t_ns + 500) // 1000,
    )
