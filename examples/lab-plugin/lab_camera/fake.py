"""A fake lab camera, that serves its bytes on a free port of this computer."""

from __future__ import annotations

import asyncio

import numpy as np

from lab_camera import wire
from sliplab.rigs.core.fakes import FakeStream
from sliplab.storage.streams import EventChunk, PulseChunk


class FakeLabCamera(FakeStream):
    """A `sliplab.rigs.core.driver.FakeEventCamera`; it serves one client.

    Args:
        size: columns and rows.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._greeting = wire.GREETING.pack(wire.MAGIC, *size, b"fake")
        self._streaming = False
        super().__init__("fake lab camera")

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
        if packets and self._streaming:
            self.write(packets)

    def stall(self) -> None:
        """Send nothing from now on; the connection stays."""
        self.silence()

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        self._streaming = False
        self._write(self._greeting)
        try:
            while command := await reader.read(1):
                self._write(wire.HEAD.pack(command, 0))
                self._streaming = command == wire.STARTED
        finally:
            self._streaming = False
