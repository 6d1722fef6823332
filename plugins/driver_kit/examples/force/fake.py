"""A fake of the example force sensor, that serves its samples on a free port of this computer."""

from __future__ import annotations

import asyncio

import numpy as np

from sliplab.plugins.driver_kit.examples.force.driver import LOAD, OVERLOAD, SAMPLE, START, ZERO
from sliplab.rigs.core.fakes import FakeStream
from sliplab.storage.streams import WrenchChunk


class FakeExampleForce(FakeStream):
    """A `sliplab.rigs.core.driver.FakeForceSensor`."""

    def __init__(self) -> None:
        self._streaming, self._overloaded = False, False
        self._last, self._zero = np.zeros(1, SAMPLE), np.zeros(1, SAMPLE)
        super().__init__("fake force sensor")

    def send(self, chunk: WrenchChunk) -> None:
        """Send samples of the plate's load, in the sensor's axes and clock."""
        samples = np.zeros(len(chunk), SAMPLE)
        samples["kind"] = OVERLOAD if self._overloaded else LOAD
        samples["t"], samples["force"], samples["torque"] = (
            chunk.t_ns,
            chunk.force_n,
            chunk.torque_nm,
        )
        if len(samples):
            self._last = samples[-1:].copy()
        samples["force"] -= self._zero["force"]
        samples["torque"] -= self._zero["torque"]
        if self._streaming:
            self.write(samples.tobytes())

    def overload(self) -> None:
        """The load is out of range from now on."""
        self._overloaded = True
        bad = np.zeros(1, SAMPLE)
        bad["kind"] = OVERLOAD
        self.write(bad.tobytes())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        self._streaming = False
        while command := await reader.read(1):
            if command == ZERO:
                self._zero = self._last
                continue
            self._streaming = command == START
            if self._streaming:
                first = np.zeros(1, SAMPLE)
                first["kind"] = START
                self._write(first.tobytes())
