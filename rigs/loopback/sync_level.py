"""The level of a simulated sync line at any time, for whoever looks at it now and then."""

from __future__ import annotations

import numpy as np

from sliplab.rigs.core.pulse_code import code_bits
from sliplab.rigs.devices.sync_box.fake import Train
from sliplab.storage.clockmap import ClockMap

PULSE_NS = 5_000_000
"""Length of a pulse on the line, as the firmware sends it at 100 ticks a second."""
_BITS = 1 << 12


class SyncLevel:
    """The sync line's level at any time, from the train that runs; asked in the arm's thread.

    Args:
        box: true time of all trials to the box's clock, ns.
    """

    def __init__(self, box: ClockMap) -> None:
        self._box = box
        self._train: Train | None = None
        self._bits = np.zeros(0, np.uint8)
        self._ticks: int | None = None

    def follow(self, train: Train | None, sent: int) -> None:
        """A train begins, or (None) the one that ran has ended after `sent` ticks."""
        if train is None:
            self._ticks = sent
        else:
            self._bits = np.zeros(0, np.uint8)
            self._ticks, self._train = None, train

    def high(self, total_ns: int) -> bool:
        """Whether the line is high at a true time of all trials."""
        train, ticks = self._train, self._ticks
        if train is None:
            return False
        passed = self._box.to_reference(total_ns) - train.first_ns
        period = 1e9 / train.rate_hz
        tick = int(passed // period)
        if tick < 0 or (ticks is not None and tick >= ticks):
            return False
        if tick >= len(self._bits):
            self._bits = code_bits(train.seed, max(2 * tick, _BITS), train.code)
        return bool(self._bits[tick]) and passed - tick * period < min(PULSE_NS, period / 2)
