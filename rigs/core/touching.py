"""Detection of the touch on the plate: from the event rate, or from the centre marker's motion.

Both work while the arm creeps in. The event camera sees the image of the centre papilla change; the
outside camera sees its white tip stop moving with the others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy import special

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.storage.streams import EventChunk

F64 = npt.NDArray[np.float64]

TOUCH_HALF_PX = 30
"""Half the side of the square around the centre papilla in which events are counted."""
QUIET_S = 0.5
"""Time for which the arm is at rest to measure the noise."""
POLL_S = 0.01
"""Period of the checks during the slow approach."""


def count_central(
    chunk: EventChunk, size_px: tuple[int, int], centre_px: tuple[float, float] | None
) -> int:
    """Count events within `TOUCH_HALF_PX` of the centre papilla's image.

    Args:
        size_px: width and height of the event camera.
        centre_px: column and row; None: the image centre.
    """
    column, row = centre_px or (size_px[0] // 2, size_px[1] // 2)
    x, y = np.abs(chunk.x - np.float64(column)), np.abs(chunk.y - np.float64(row))
    return int(np.count_nonzero((x < TOUCH_HALF_PX) & (y < TOUCH_HALF_PX)))


class NoiseWatch:
    """Detects an event camera that has gone silent: the noise that it showed at rest ends.

    Args:
        chunk: events of the last `QUIET_S` at rest, of the whole array.
        now_ns: the rig's clock.
        may_be_silent: True for a simulated camera, which may have no noise.

    Raises:
        RigError: no event came at all.
    """

    SILENT_S: ClassVar[float] = 0.2
    """Shortest silence that is a fault."""
    EXPECTED: ClassVar[int] = 30
    """Events of the noise that a silence must have lasted for: by chance it is below 1e-9."""

    def __init__(self, chunk: EventChunk, now_ns: Callable[[], int], may_be_silent: bool) -> None:
        if not len(chunk) and not may_be_silent:
            text = f"sent no event within {QUIET_S:g} s, not even noise: a touch would not show"
            raise RigError("event camera", f"{text}; check its lens, settings and cable")
        rate = len(chunk) / QUIET_S
        self._longest_s = max(self.SILENT_S, self.EXPECTED / rate) if rate else np.inf
        self._stall = StallTimer(now_ns)
        self._now_ns, self._soonest_ns = now_ns, np.inf
        self._newest_us: int | None = None
        self.check(chunk)

    def check(self, chunk: EventChunk) -> None:
        """Hold the events since the last call against the noise; late ones are no news.

        Raises:
            RigError: no newer event has come in time for too long.
        """
        newest_us = int(chunk.t_us.max()) if len(chunk) else None
        if newest_us is not None and (self._newest_us is None or newest_us > self._newest_us):
            on_way_ns = self._now_ns() - 1000 * newest_us
            self._soonest_ns = min(self._soonest_ns, on_way_ns)
            if on_way_ns - self._soonest_ns <= 1e9 * self._longest_s:
                self._newest_us = newest_us
        silent_s = self._stall.waited_s((self._newest_us,))
        if silent_s > self._longest_s:
            raise RigError(
                "event camera",
                f"sent no newer event for {silent_s:.2f} s, not even noise, so a touch would not "
                f"show; the arm was stopped: check its cable{OR_BUSY}",
            )


class RateTouch:
    """Detects a touch from the events around the centre papilla.

    The noise is the count in `QUIET_S` at rest; a touch is a count in 50 ms above the noise mean by
    eight standard deviations (Poisson) plus ten events. Where a touch makes few events, or noise
    many, no count may exceed that, or a late one only: the whole creep then shows where the rate
    rose.
    """

    LATE_S: ClassVar[float] = 0.025
    """Delay from the middle of those 50 ms to their end, when the touch is detected."""
    LONG_S: ClassVar[float] = 0.4
    """Time for which the rate must have risen before the rise, not the 50 ms, is the touch."""
    LEAST_S: ClassVar[float] = 0.5
    """Time before a rise: an earlier one is due to the motion, or to contact."""
    RISE: ClassVar[float] = 1.7
    """Smallest rate after a rise, over that before it."""
    LOG_RATIO: ClassVar[float] = 32.0
    """Smallest logarithm of a rise's likelihood ratio: that of eight standard deviations."""

    def __init__(self, quiet: int) -> None:
        """Set the limit from `quiet`, the number of central events in `QUIET_S`."""
        mean = quiet * 0.1  # per 50 ms
        self.limit = mean + 8 * mean**0.5 + 10
        self._counts: list[int] = []
        self._depths_mm: list[float] = []
        self._at_ns: list[int] = []
        self._noticed = False

    def touched(self, count: int, depth_mm: float, now_ns: int) -> bool:
        """Return whether the last 50 ms, with `count` events in the last `POLL_S`, are a touch."""
        self._counts.append(count)
        self._depths_mm.append(depth_mm)
        self._at_ns.append(now_ns)
        self._noticed = sum(self._counts[-5:]) > self.limit
        return self._noticed

    def surface_mm(self, speed_mm_s: float) -> float | None:
        """Return the depth of the touch, None if there was none.

        It is the depth at which the rate rose, if that is well before the last count; else the last
        depth less the delay, if that count was a touch.
        """
        if not self._counts:
            return None
        rise = self._rise()
        if rise is not None and self._at_ns[-1] - self._at_ns[rise] > self.LONG_S * 1e9:
            return self._depths_mm[rise]
        return self._depths_mm[-1] - speed_mm_s * self.LATE_S if self._noticed else None

    def _rise(self) -> int | None:
        """Return the last count before the rate rose by `RISE` or more, None if it did not.

        The rise is the most likely change of a Poisson process. A light that brightens slowly has
        one, too, but less high, unless the noise grows more than threefold.
        """
        at_s = (np.array(self._at_ns) - self._at_ns[0]) * 1e-9
        first = int(np.searchsorted(at_s, self.LEAST_S))
        if first > len(at_s) - 2:
            return None
        sums = np.cumsum(self._counts) - self._counts[0]
        before, all_s = sums[first:-1], at_s[-1]
        after, rate = sums[-1] - before, before / at_s[first:-1]
        later = after / (all_s - at_s[first:-1])
        gain = special.xlogy(before, rate) + special.xlogy(after, later)
        best = int(np.argmax(gain))
        ratio = gain[best] - special.xlogy(sums[-1], sums[-1] / all_s)
        risen = ratio > self.LOG_RATIO and later[best] >= self.RISE * rate[best]
        return first + best if risen else None


class MarkerTouch:
    """Detects a touch from the centre marker: it departs from the others, or it appears.

    The common motion of all markers (sway or tremor of the arm, a knocked camera) is the median of
    the others' shifts, and is subtracted. A straight line through earlier frames predicts the rest
    of the centre marker's motion; a touch is `RUN` consecutive frames that are off this line by
    eight standard deviations, and by `MIN_PX`. A centre marker that was not visible in the first
    `HISTORY` frames touches at the first of `RUN` frames that show it.
    """

    RUN: ClassVar[int] = 3
    HISTORY: ClassVar[int] = 40
    SKIP: ClassVar[int] = 10
    """Number of latest frames that the fit leaves out, lest a slow onset bias it."""
    MIN_PX: ClassVar[float] = 0.05
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
        """Add frames; return the host time of the first frame of a touch, or None.

        Args:
            markers_px: column and row of every marker, the centre's first, (k, m, 2), NaN where
                a marker is not visible.
            host_ns: arrival time of each frame, (k,).
        """
        for places, when in zip(markers_px, host_ns.tolist(), strict=True):
            self.frames += 1
            found = self._add_frame(places.astype(np.float64), when)
            if found is not None:
                return found
        return None

    def _add_frame(self, places: F64, when: int) -> int | None:
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
        """Return the distance of a frame from the fitted line, and its limit, px."""
        host = np.array(self._host, np.float64)[: -self.SKIP] - self._host[0]
        apart_px = np.array(self._apart)[: -self.SKIP]
        centre = host.mean()
        spread = ((host - centre) ** 2).sum()
        slope = ((host - centre)[:, None] * apart_px).sum(axis=0) / spread
        ahead = when - self._host[0] - centre
        residual = apart_px - apart_px.mean(axis=0) - (host - centre)[:, None] * slope
        sigma = float(np.sqrt((residual**2).sum() / (2 * len(apart_px) - 4)))
        # the line itself is uncertain, more so the farther it is extrapolated
        sigma *= (1.0 + 1.0 / len(apart_px) + ahead**2 / spread) ** 0.5
        off = apart - apart_px.mean(axis=0) - ahead * slope
        return float(np.hypot(*off)), max(8.0 * sigma, self.MIN_PX)
