"""A server of dv's network streams, as a DVXplorer's data are served over the network.

The library's own writer (2.0.4) is not suitable as a fake: each of its threads polls its sockets
without pause and occupies a core, and it accepts events one by one, at 0.7 million per second.
A stream is a header and then packets. A header is a length and a flatbuffer `IOHE` with the
stream's description; a packet is stream and length (int32 each) and a flatbuffer with a length
prefix (`storage.formats.flatbuffers`).
"""

from __future__ import annotations

import socket
import struct
import threading
from collections import deque
from contextlib import suppress

from sliplab.storage.formats.flatbuffers import events_buffer, header_buffer, triggers_buffer
from sliplab.storage.streams import I64, EventChunk, PulseChunk

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
    """Return the header of an event stream with `size` columns and rows."""
    info = "".join(
        _SIZE.format(axis=axis, value=value) for axis, value in zip("XY", size, strict=True)
    )
    text = _INFO.format(output="events", kind="EVTS", info=info, source=source)
    return header_buffer(text, 0)


def triggers_header(source: str) -> bytes:
    """Return the header of a trigger stream."""
    text = _INFO.format(output="triggers", kind="TRIG", info="", source=source)
    return header_buffer(text, 0)


def events_packet(chunk: EventChunk) -> bytes:
    """Serialise events in order of time as one packet."""
    return _packet(events_buffer(chunk))


def triggers_packet(t_us: I64, kind: int = RISING_EDGE) -> bytes:
    """Serialise triggers of one kind at these times, us, as one packet."""
    return _packet(triggers_buffer(t_us, kind))


def _packet(buffer: bytes) -> bytes:
    """Prefix a buffer with stream 0 and its length."""
    return struct.pack("<ii", 0, len(buffer)) + buffer


MOST_WAITING = 256 << 20
"""Largest backlog of a client, bytes; beyond it the stream breaks, as a camera's would."""
SEND_S = 10.0
"""Time without progress after which a client is disconnected, s."""
JOIN_S = 2.0


class DvServer:
    """Serves a stream on a free loopback port until `close`.

    Args:
        header: header that is sent to each client first.

    Attributes:
        port: listening port.
    """

    def __init__(self, header: bytes) -> None:
        self._header = header
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._threads = [
            threading.Thread(target=work, name=f"dv stream {self.port}", daemon=True)
            for work in (self._accept, self._send)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def clients(self) -> int:
        """Number of connected clients."""
        with self._changed:
            return len(self._clients)

    @property
    def waiting(self) -> int:
        """Number of packets that are not sent yet."""
        with self._changed:
            return len(self._waiting)

    def send(self, packet: bytes) -> None:
        """Queue a packet for every connected client; returns at once."""
        with self._changed:
            if self._closing or not self._clients:
                return
            self._waiting.append(packet)
            self._bytes += len(packet)
            if self._bytes > MOST_WAITING:
                self._cut()
            self._changed.notify_all()

    def wait_for_client(self, within_s: float) -> bool:
        """Wait for a client; return whether one is connected."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._clients), within_s)

    def drain(self, within_s: float) -> bool:
        """Wait until the queue is empty; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting, within_s)

    def close(self) -> None:
        """Disconnect every client and release the port; safe to call more than once."""
        with self._changed:
            self._closing = True
            self._cut()
            self._changed.notify_all()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(JOIN_S)

    def _cut(self) -> None:
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()
        self._clients = []
        self._waiting.clear()
        self._bytes = 0

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.settimeout(SEND_S)
            with suppress(OSError):
                client.sendall(self._header)
                with self._changed:
                    if self._closing:
                        client.close()
                        return
                    self._clients.append(client)
                    self._changed.notify_all()

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if self._closing:
                    return
                packet, clients = self._waiting[0], list(self._clients)
            for client in clients:
                try:
                    client.sendall(packet)
                except OSError:
                    with self._changed:
                        if client in self._clients:
                            self._clients.remove(client)
                    client.close()
            with self._changed:
                if self._waiting and self._waiting[0] is packet:
                    self._waiting.popleft()
                    self._bytes -= len(packet)
                self._changed.notify_all()


NAME = "stand-in"


class LiveDvxplorer:
    """A fake event camera whose data are supplied by this process.

    Args:
        size: columns and rows.

    Attributes:
        ports: ports of the event and the trigger stream.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._events = DvServer(events_header(size, NAME))
        self._triggers = DvServer(triggers_header(NAME))
        self.ports = self._events.port, self._triggers.port
        self._silent = False

    @property
    def address(self) -> tuple[int, int]:
        """The ports, for `reach` of the driver."""
        return self.ports

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events and rising edges of the input; nothing while stalled."""
        if self._silent:
            return
        if len(chunk):
            self._events.send(events_packet(chunk))
        if len(pulses.t_ns):
            self._triggers.send(triggers_packet(pulses.t_ns // 1000))

    def stall(self) -> None:
        """Stop sending; the connections stay open."""
        self._silent = True

    def resume(self) -> None:
        """Resume sending; data from during the stall are lost."""
        self._silent = False

    def close(self) -> None:
        """Break the connections, as an unplugged cable would; safe to call more than once."""
        self._events.close()
        self._triggers.close()
