"""A fake of the example scalar sensor, on a pseudo terminal."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any

from sliplab.rigs.core.fakes import FakeSerial


class FakeExampleScalar(FakeSerial):
    """A `sliplab.rigs.core.driver.FakeSensor`."""

    clocked = False

    def __init__(self) -> None:
        self._running = False
        super().__init__("fake scalar sensor")

    def send(self, rows: Mapping[str, Any]) -> None:
        """Send readings, without their times."""
        if self._running:
            self.write("".join(f"{value}\n" for value in rows["value"].tolist()).encode())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            self._running = line == b"RUN\n"
            if self._running:
                self._write(b"RUNNING\n")
