"""A fake of a device that sends rows of numbers on a serial port, as its declaration says."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from sliplab.plugins.record.columns import UNITS, ColumnsSettings
from sliplab.rigs.core.fakes import FakeSerial


class FakeColumns(FakeSerial):
    """A `sliplab.rigs.core.driver.FakeSensor`."""

    def __init__(self, settings: ColumnsSettings) -> None:
        self._settings = settings
        self.clocked = settings.time_column is not None
        super().__init__("fake columns")

    def send(self, rows: Mapping[str, Any]) -> None:
        """Send rows as lines or packets."""
        known = self._settings
        columns = dict(rows)
        if known.time_column is not None:
            columns[known.time_column] = rows["t"] / UNITS[known.time_unit]
        none = np.zeros(len(rows["t"]))
        values = zip(*(columns.get(name, none).tolist() for name in known.columns), strict=True)
        if known.struct is not None:
            self.write(b"".join(struct.pack(known.struct, *row) for row in values))
        else:
            lines = (known.separator.join(map(repr, row)) for row in values)
            self.write("".join(f"{line}\n" for line in lines).encode())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        while await reader.read(4096):  # what is sent at its start
            pass
