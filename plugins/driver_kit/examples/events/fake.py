"""A fake of the example event camera, that serves its packets on a free port of this computer."""

from __future__ import annotations

import asyncio

import numpy as np

from sliplab.plugins.driver_kit.examples.events.driver import (
    EDGE,
    EDGES,
    EVENT,
    EVENTS,
    HEAD,
    SIZE,
    START,
)
from sliplab.rigs.core.fakes import FakeStream
from sliplab.storage.streams import EventChunk, PulseChunk


class FakeExampleEvents(FakeStream):
    """A `sliplab.rigs.core.driver.FakeEventCamera`.

    Args:
        size: columns and rows.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size, self._streaming = size, False
        super().__init__("fake event camera")

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events, and rising edges of the input; nothing while it is stalled."""
        events = np.empty(len(chunk), EVENT)
        events["t"], events["x"], events["y"], events["p"] = chunk.t_us, chunk.x, chunk.y, chunk.p
        edges = (pulses.t_ns // 1000).astype(EDGE)
        if self._streaming:
            self.write(
                HEAD.pack(EVENTS, len(events))
                + events.tobytes()
                + HEAD.pack(EDGES, len(edges))
                + edges.tobytes()
            )

    def stall(self) -> None:
        """Send and answer nothing from now on; the connection stays."""
        self.silence()

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        self._streaming = False
        self._write(SIZE.pack(*self._size))
        while command := await reader.read(1):
            self._streaming = command == START
            if self._streaming:
                self._write(HEAD.pack(START, 0))
