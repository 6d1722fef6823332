"""dv's network streams, byte by byte: what dv-processing's reader takes for a camera's.

The library's own writer (2.0.4) cannot stand in for a camera here: each of its threads asks its
sockets without ever resting and takes a core, and events go in one by one, at 0.7 million a second.
On the wire there is a header and then packets. A header is a length and a flatbuffer `IOHE` with
the stream's description; a packet is stream and length (int32 each) and a flatbuffer with its
length in front: `EVTS`, a vector of 16-byte structs, or `TRIG`, a vector of tables. Layouts were
read off what dv-processing 2.0.4 sends (tests hold them against it); all numbers little-endian.
"""

from __future__ import annotations

import struct

import numpy as np
import numpy.typing as npt

from storage.streams import I64, EventChunk

EVENT = np.dtype(
    {
        "names": ["t", "x", "y", "p"],
        "formats": ["<i8", "<i2", "<i2", "u1"],
        "offsets": [0, 8, 10, 12],
        "itemsize": 16,
    }
)
"""One event: time in us, column, row, whether it became brighter."""
RISING_EDGE = 1
"""`EXTERNAL_SIGNAL_RISING_EDGE` of dv-processing's `TriggerType`."""
_INFO = """<dv version="2.0">
    <node name="outInfo" path="/outInfo/">
        <node name="0" path="/outInfo/0/">
            <attr key="compression" type="string">NONE</attr>
            <attr key="originalModuleName" type="string">dv-processing</attr>
            <attr key="originalOutputName" type="string">{output}</attr>
            <attr key="typeIdentifier" type="string">{kind}</attr>
            <node name="info" path="/outInfo/0/info/">
{info}                <attr key="source" type="string">{source}</attr>
            </node>
        </node>
    </node>
</dv>
"""
_SIZE = '                <attr key="size{axis}" type="int">{value}</attr>\n'
_VECTOR = bytes.fromhex("0000 0600 0800 0400 06000000 04000000")
"""A table with one field, a vector, whose length follows: padding, vtable, table."""
_TRIGGER_VTABLE = struct.pack("<4H", 8, 16, 8, 7)
"""Of a trigger's table of 16 bytes: time at 8, kind at 7."""


def events_header(size: tuple[int, int], source: str) -> bytes:
    """What comes first on a stream of events of so many columns and rows."""
    info = "".join(
        _SIZE.format(axis=axis, value=value) for axis, value in zip("XY", size, strict=True)
    )
    return _header(_INFO.format(output="events", kind="EVTS", info=info, source=source))


def triggers_header(source: str) -> bytes:
    """What comes first on a stream of triggers."""
    return _header(_INFO.format(output="triggers", kind="TRIG", info="", source=source))


def events_packet(chunk: EventChunk) -> bytes:
    """Events in order of time as one packet."""
    rows = np.zeros(len(chunk), EVENT)
    rows["t"], rows["x"], rows["y"], rows["p"] = chunk.t_us, chunk.x, chunk.y, chunk.p
    return _packet(b"EVTS", struct.pack("<I", len(chunk)) + rows.tobytes())


def triggers_packet(t_us: I64, kind: int = RISING_EDGE) -> bytes:
    """Triggers of one kind at these times, us, as one packet."""
    n = len(t_us)
    # counted from the length in front of the flatbuffer: count at 28, then an offset for each
    tables = (32 + 4 * n + 8 + 7) // 8 * 8
    places = tables + 16 * np.arange(n, dtype=np.int64)
    offsets: npt.NDArray[np.uint32] = (places - (32 + 4 * np.arange(n))).astype("<u4")
    rows = np.zeros(
        n,
        np.dtype(
            {
                "names": ["vtable", "kind", "t"],
                "formats": ["<i4", "u1", "<i8"],
                "offsets": [0, 7, 8],
                "itemsize": 16,
            }
        ),
    )
    rows["vtable"], rows["kind"], rows["t"] = places - (tables - 8), kind, t_us
    padding = bytes(tables - 8 - (32 + 4 * n))
    vector = struct.pack("<I", n) + offsets.tobytes()
    return _packet(b"TRIG", vector + padding + _TRIGGER_VTABLE + rows.tobytes())


def _packet(kind: bytes, vector: bytes) -> bytes:
    """Stream 0, length, and the flatbuffer with its own length in front."""
    body = struct.pack("<I", 16) + kind + _VECTOR + vector
    return struct.pack("<iiI", 0, len(body) + 4, len(body)) + body


def _header(info: str) -> bytes:
    """Length, and a table of compression (0), position of an index (-1: none) and description."""
    text = info.encode()
    table = struct.pack("<iiIq", 10, 0, 12, -1)
    body = struct.pack("<I", 24) + b"IOHE" + bytes(6) + struct.pack("<5H", 10, 20, 4, 12, 8) + table
    body += struct.pack("<I", len(text)) + text + b"\0"
    body += bytes(-len(body) % 4)
    return struct.pack("<I", len(body)) + body
