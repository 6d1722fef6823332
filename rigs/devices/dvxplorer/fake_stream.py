"""dv's network streams, byte by byte: what dv-processing's reader takes for a camera's.

The library's own writer (2.0.4) cannot stand in for a camera here: each of its threads asks its
sockets without ever resting and takes a core, and events go in one by one, at 0.7 million a second.
On the wire there is a header and then packets. A header is a length and a flatbuffer `IOHE` with
the stream's description; a packet is stream and length (int32 each) and a flatbuffer with its
length in front (`storage.formats.dv_buffers`).
"""

from __future__ import annotations

import struct

from sliplab.storage.formats.dv_buffers import events_buffer, header_buffer, triggers_buffer
from sliplab.storage.streams import I64, EventChunk

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


def events_header(size: tuple[int, int], source: str) -> bytes:
    """What comes first on a stream of events of so many columns and rows."""
    info = "".join(
        _SIZE.format(axis=axis, value=value) for axis, value in zip("XY", size, strict=True)
    )
    text = _INFO.format(output="events", kind="EVTS", info=info, source=source)
    return header_buffer(text, 0)


def triggers_header(source: str) -> bytes:
    """What comes first on a stream of triggers."""
    text = _INFO.format(output="triggers", kind="TRIG", info="", source=source)
    return header_buffer(text, 0)


def events_packet(chunk: EventChunk) -> bytes:
    """Events in order of time as one packet."""
    return _packet(events_buffer(chunk))


def triggers_packet(t_us: I64, kind: int = RISING_EDGE) -> bytes:
    """Triggers of one kind at these times, us, as one packet."""
    return _packet(triggers_buffer(t_us, kind))


def _packet(buffer: bytes) -> bytes:
    """Stream 0, length, and what comes."""
    return struct.pack("<ii", 0, len(buffer)) + buffer
