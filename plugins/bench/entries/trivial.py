"""Detectors that ignore slip: a fair table ranks them last.

The hash is that of splitmix64 (Steele, Lea and Flood 2014).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector import Cost, Detector, Evidence, Scene
from sliplab.storage.streams import EventChunk

STRIDE_US = 10_000


class Blind(Detector):
    """A detector that knows only the time."""

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        self._before_us = 0

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        first = self._before_us // STRIDE_US + 1
        t_us = np.arange(first, until_us // STRIDE_US + 1, dtype=np.int64) * STRIDE_US
        self._before_us = until_us
        return Evidence.of(t_us, self.value(t_us))

    @abstractmethod
    def value(self, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """Return evidence at times of a scene, (n,)."""

    def cost(self) -> Cost:
        """Return that it costs nothing."""
        return Cost(0, 0)


class Always(Blind):
    """Always triggers."""

    def value(self, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """See `Blind`."""
        return np.ones(len(t_us))


class Never(Blind):
    """Never triggers."""

    def value(self, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """See `Blind`."""
        return np.full(len(t_us), -np.inf)


class Random(Blind):
    """Triggers at random: a hash of the time and the number of events, which is noise."""

    def begin(self, width: int, height: int) -> None:
        """See `Detector`."""
        super().begin(width, height)
        self._seen = 0

    def push(self, events: EventChunk, until_us: int) -> Evidence:
        """See `Detector`."""
        self._events = events
        found = super().push(events, until_us)
        self._seen += len(events)
        return found

    def value(self, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """See `Blind`."""
        seen = self._seen + np.searchsorted(self._events.t_us, t_us)
        mixed = (t_us.astype(np.uint64) << np.uint64(32)) ^ seen.astype(np.uint64)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            mixed = (mixed ^ (mixed >> np.uint64(shift))) * np.uint64(factor)
        return (mixed >> np.uint64(11)) / 2.0**53


class ByTheClock(Blind):
    """Triggers when most training scenes slip, by the time since the scene began."""

    def train(self, scenes: Sequence[Scene], validation: Sequence[Scene]) -> None:
        """See `Detector`."""
        self._usual_us = float(np.median([scene.slip.physical_us for scene in scenes]))

    def value(self, t_us: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
        """See `Blind`."""
        return -np.abs(t_us - self._usual_us)
