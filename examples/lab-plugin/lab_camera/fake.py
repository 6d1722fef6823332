"""A fake lab camera, that serves its bytes on a free port of this computer."""

from __future__ import annotations

import asyncio
import socket

import numpy as np

from lab_camera import wire
from sliplab.rigs.core.fakes import Connections, LoopThread
from sliplab.storage.streams import EventChunk, PulseChunk

HOST = "127.0.0.1"
MOST_WAITING = 64 << 20
"""Bytes that may wait for a client; then the connection breaks, as a camera's would."""


class FakeLabCamera:
    """A `sliplab.rigs.core.driver.FakeEventCamera`; it serves one client.

    Args:
        size: columns and rows.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._greeting = wire.GREETING.pack(wire.MAGIC, *size, b"fake")
        self._connections = Connections()
        self._client: asyncio.StreamWriter | None = None
        self._streaming = self._silent = self._closed = False
        with socket.create_server((HOST, 0)) as probe:
            self._port: int = probe.getsockname()[1]
        self._thread = LoopThread(f"fake camera {self._port}")
        self._thread.call(lambda: self._connections.listen(HOST, self._port, self._talk))

    @property
    def address(self) -> tuple[str, int]:
        """Host and port, for `reach` of the driver."""
        return HOST, self._port

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events, and rising edges of the input; nothing while it is stalled."""
        events = np.empty(len(chunk), wire.EVENT)
        events["t"], events["x"], events["y"], events["p"] = chunk.t_us, chunk.x, chunk.y, chunk.p
        edges = (pulses.t_ns // 1000).astype(wire.EDGE)
        packets = b"".join(
            wire.HEAD.pack(kind, len(items)) + items.tobytes()
            for kind, items in ((wire.EVENTS, events), (wire.EDGES, edges))
            if len(items)
        )
        if packets and not self._closed:
            self._thread.call(lambda: self._write(packets))

    def stall(self) -> None:
        """Send nothing from now on; the connection stays."""
        self._silent = True

    def close(self) -> None:
        """Unplug it: the connection breaks. Any number of times."""
        if not self._closed:
            self._closed = True
            self._thread.call(self._connections.cut)
            self._thread.close()

    def _write(self, data: bytes) -> None:
        writer = self._client
        if writer is None or not self._streaming or self._silent:
            return
        writer.write(data)
        if writer.transport.get_write_buffer_size() > MOST_WAITING:
            writer.transport.abort()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._client is not None:
            return
        self._client, self._streaming = writer, False
        try:
            writer.write(self._greeting)
            while command := await reader.read(1):
                if self._silent:
                    continue
                writer.write(wire.HEAD.pack(command, 0))
                self._streaming = command == wire.STARTED
        finally:
            self._client, self._streaming = None, False
