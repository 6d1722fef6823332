"""A fake camera that streams EVT 3.0 on a free port of this computer, as `source: stream` reads it.

Each client gets a RAW header and an encoder of its own. Edges are held back until events of their
time have come, because the words of a stream are in order of time.
"""

from __future__ import annotations

import asyncio
import socket

import numpy as np

from sliplab.rigs.core.fakes import Connections, LoopThread
from sliplab.storage.streams import I64, EventChunk, PulseChunk
from sliplab_prophesee.evt import Evt3Encoder, Header

HOST = "127.0.0.1"
MOST_WAITING = 64 << 20
"""Bytes that may wait for a client; then the connection breaks, as a camera's would."""


class FakeProphesee:
    """A `sliplab.rigs.core.driver.FakeEventCamera`.

    Args:
        size: columns and rows.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._header = Header(3, size, "fake").text()
        self._connections = Connections()
        self._clients: dict[asyncio.StreamWriter, Evt3Encoder] = {}
        self._edges_us = np.empty(0, np.int64)
        self._silent = self._closed = False
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
        edges_us = np.concatenate([self._edges_us, pulses.t_ns // 1000])
        due = edges_us <= (chunk.t_us[-1] if len(chunk) else -1)
        self._edges_us = edges_us[~due]
        if len(chunk) and not self._closed:
            self._thread.call(lambda: self._write(chunk, edges_us[due]))

    def stall(self) -> None:
        """Send nothing from now on; the connections stay."""
        self._silent = True

    def close(self) -> None:
        """Unplug it: the connections break. Any number of times."""
        if not self._closed:
            self._closed = True
            self._thread.call(self._connections.cut)
            self._thread.close()

    def _write(self, chunk: EventChunk, edges_us: I64) -> None:
        for writer, encoder in self._clients.items():
            if self._silent or writer.is_closing():
                continue
            writer.write(encoder.encode(chunk, edges_us))
            if writer.transport.get_write_buffer_size() > MOST_WAITING:
                writer.transport.abort()

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not self._silent:
            writer.write(self._header)
        self._clients[writer] = Evt3Encoder()
        try:
            while await reader.read(1024):
                pass  # a stream takes no commands
        finally:
            del self._clients[writer]
