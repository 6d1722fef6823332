"""A fake sender of an LSL stream: liblsl's own outlet in this process."""

from __future__ import annotations

import os
from collections.abc import Mapping
from itertools import count
from typing import Any

import numpy as np
import pylsl

from sliplab.plugins.record.lsl import LslSettings

RATE_HZ = 1000.0
_NUMBER = count()


class FakeLsl:
    """A `sliplab.rigs.core.driver.FakeSensor` with one channel.

    Attributes:
        address: what settings change to reach it.
        behind_s: samples are given out once the clock was read after them.
    """

    clocked = False  # jumps of the sender's clock are taken out
    behind_s = 4.0

    def __init__(self, settings: LslSettings) -> None:
        self.address = {"name": f"{settings.name}-{os.getpid()}-{next(_NUMBER)}"}
        name = self.address["name"]
        info = pylsl.StreamInfo(name, "fake", 1, RATE_HZ, "double64", name)
        info.set_channel_labels(["value"])
        self._outlet: Any = pylsl.StreamOutlet(info)
        self._silent = False

    def send(self, rows: Mapping[str, Any]) -> None:
        """Send samples with their stamps."""
        if self._outlet is not None and not self._silent:
            stamps = (rows["t"] / 1e9).tolist()
            for value, stamp in zip(rows["value"].tolist(), stamps, strict=True):
                self._outlet.push_sample(np.array([value]), stamp)

    def silence(self) -> None:
        """Send nothing from now on; the clock can still be read."""
        self._silent = True

    def close(self) -> None:
        """End the stream."""
        self._outlet = None
