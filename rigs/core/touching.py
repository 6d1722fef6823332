"""The moment of touching the plate: by the rate of events, or by the centre marker's motion.

Both look while the arm creeps in. The event camera sees the centre papilla's image change; the
outside camera sees that its white top no longer goes where all the others go.
"""

from __future__ import annotations

from collections import deque
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from sliplab.storage.streams import EventChunk

F64 = npt.NDArray[np.float64]

TOUCH_HALF_PX = 30
"""Half the side of the square in which touching off looks for the centre papilla."""
QUIET_S = 0.5
"""Time for which the arm stands still to measure the noise."""
LOOK_S = 0.01
"""Period of the checks during the slow approach."""


def count_central(
    chunk: EventChunk, size_px: tuple[int, int], centre_px: tuple[float, float] | None
) -> int:
    """Events within `TOUCH_HALF_PX` of where the centre papilla is seen.

    Args:
        size_px: width and height of the event camera.
        centre_px: column and row; None: the picture's centre.
    """
    column, row = centre_px or (size_px[0] // 2, size_px[1] // 2)
    x, y = np.abs(chunk.x - np.float64(column)), np.abs(chunk.y - np.float64(row))
    return int(np.count_nonzero((x < TOUCH_HALF_PX) & (y < TOUCH_HALF_PX)))


class RateTouch:
    """A touch by events round the centre papilla.

    The count in `QUIET_S` of standing still is the noise; a touch is a count in 50 ms above its
    mean by eight standard deviations (Poisson) and ten events.
    """

    LATE_S: ClassVar[float] = 0.025
    """From the middle of those 50 ms to their end, when the touch is noticed."""

    def __init__(self, quiet: int) -> None:
        """`quiet`: central events in `QUIET_S`."""
        mean = quiet * 0.1  # per 50 ms
        self.limit = mean + 8 * mean**0.5 + 10
        self._recent: deque[int] = deque(maxlen=5)

    def touched(self, count: int) -> bool:
        """Return whether the last 50 ms, with `count` events in the last `LOOK_S`, are a touch."""
        self._recent.append(count)
        return sum(self._recent) > self.limit


class MarkerTouch:
    """A touch by the centre marker: it leaves the others, or it appears.

    What all markers do together (the arm's sway, its tremor, a camera that is knocked) is the
    median of the others' shifts, and is taken away. What is left of the centre marker's way is
    foretold by a straight line through the frames before; a touch is `RUN` frames in a row that
    are off it by eight standard deviations, and by `LEAST_PX`. A centre marker that was never
    seen in the first `HISTORY` frames touches with the first of `RUN` frames that show it.
    """

    RUN: ClassVar[int] = 3
    HISTORY: ClassVar[int] = 40
    SKIP: ClassVar[int] = 10
    """Latest frames that the line leaves out: a slow beginning must not bend it."""
    LEAST_PX: ClassVar[float] = 0.05
    KEPT: ClassVar[int] = 200

    def __init__(self) -> None:
        self.frames = 0
        self._reference: F64 | None = None
        self._host: deque[int] = deque(maxlen=self.KEPT)
        self._apart: deque[F64] = deque(maxlen=self.KEPT)
        self._run: list[int] = []
        self._appeared: list[int] = []
        self._seen = 0

    def add(self, markers_px: F64, host_ns: npt.NDArray[np.int64]) -> int | None:
        """Look at frames; the host time of the first one of a touch, or None.

        Args:
            markers_px: column and row of every marker, the centre's first, (k, m, 2), NaN where
                it was not seen.
            host_ns: when each frame came, (k,).
        """
        for places, when in zip(markers_px, host_ns.tolist(), strict=True):
            self.frames += 1
            found = self._look(places.astype(np.float64), when)
            if found is not None:
                return found
        return None

    def _look(self, places: F64, when: int) -> int | None:
        if not np.isfinite(places[0]).all():
            self._appeared.clear()
            return None
        self._seen += 1
        if self.frames - self._seen >= self.HISTORY:
            self._appeared.append(when)
            return self._appeared[0] if len(self._appeared) >= self.RUN else None
        if self._reference is None:
            self._reference = places
            return None
        shift = places - self._reference
        others = shift[1:][np.isfinite(shift[1:]).all(axis=1)]
        if not len(others):
            return None
        apart = shift[0] - np.median(others, axis=0)
        if len(self._apart) >= self.HISTORY:
            off, limit = self._off_line(apart, when)
            if off > limit:
                self._run.append(when)
                return self._run[0] if len(self._run) >= self.RUN else None
        self._run.clear()
        self._host.append(when)
        self._apart.append(apart)
        return None

    def _off_line(self, apart: F64, when: int) -> tuple[float, float]:
        """Return how far a frame is from the line through those before, and its limit, px."""
        host = np.array(self._host, np.float64)[: -self.SKIP] - self._host[0]
        way = np.array(self._apart)[: -self.SKIP]
        centre = host.mean()
        spread = ((host - centre) ** 2).sum()
        slope = ((host - centre)[:, None] * way).sum(axis=0) / spread
        ahead = when - self._host[0] - centre
        rest = way - way.mean(axis=0) - (host - centre)[:, None] * slope
        sigma = float(np.sqrt((rest**2).sum() / (2 * len(way) - 4)))
        # the line itself is not exact, the less so the farther it is drawn out
        sigma *= (1.0 + 1.0 / len(way) + ahead**2 / spread) ** 0.5
        off = apart - way.mean(axis=0) - ahead * slope
        return float(np.hypot(*off)), max(8.0 * sigma, self.LEAST_PX)
