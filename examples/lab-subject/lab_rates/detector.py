"""A detector: how many times the mean of the last second a step of 10 ms has in events."""

from __future__ import annotations

import numpy as np

from sliplab.analysis.detectors.detector import Detector, Evidence
from sliplab.storage.streams import EventChunk

STEP_US, STEPS = 10_000, 100


class Jump(Detector):
    """Rate of events over its own past."""

    def begin(self, width: int, height: int) -> None:
        """Forget the last scene."""
        self._counts: list[int] = []
        self._rest_us = np.empty(0, np.int64)

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """Return the ratio at the end of each step that is complete."""
        times_us = np.concatenate([self._rest_us, events.t_us])
        edges_us = STEP_US * np.arange(len(self._counts), until_us // STEP_US + 1)
        self._rest_us = times_us[times_us >= edges_us[-1]]
        values = []
        for count in np.diff(np.searchsorted(times_us, edges_us)):
            past = self._counts[-STEPS:]
            values.append(float(count) / (1.0 + float(np.mean(past) if past else 0.0)))
            self._counts.append(int(count))
        return Evidence.of(edges_us[1:], values)
