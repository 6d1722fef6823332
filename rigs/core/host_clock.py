"""The host's clock, and how long something has not moved by it.

A computer may stand still for seconds. What lived on it stood still with it, and is not at fault.
"""

from __future__ import annotations

import threading
import time


class HostClock:
    """The host's monotonic clock, by which drivers stamp arrivals; a `Clock`."""

    def __init__(self) -> None:
        self._never = threading.Event()

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary origin."""
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass; a signal's handler runs at once."""
        self._never.wait(max(seconds, 0.0))


STEP_S = 0.1
"""The most that the time between two looks counts, s."""


class StallTimer:
    """Watches a mark that ought to change; looks must follow each other."""

    def __init__(self) -> None:
        self._mark: int | None = None
        self._last_ns = self._waited_ns = 0

    def waited_s(self, mark: int) -> float:
        """For how long the mark has been the same, s."""
        now_ns = time.monotonic_ns()
        if mark != self._mark:
            self._mark, self._waited_ns = mark, 0
        else:
            self._waited_ns += min(now_ns - self._last_ns, round(STEP_S * 1e9))
        self._last_ns = now_ns
        return self._waited_ns / 1e9
