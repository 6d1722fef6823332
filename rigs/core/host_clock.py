"""The host's clock, and a stall timer.

A computer may be suspended for seconds. Its processes were suspended too, and have not stalled.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

OR_BUSY = "; or this computer is too busy"
"""Another cause of missing data: the two cannot be distinguished."""


class HostClock:
    """The host's monotonic clock, which gives the arrival times of data; a `Clock`."""

    def __init__(self) -> None:
        self._never = threading.Event()

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary origin."""
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass; signal handlers still run at once."""
        self._never.wait(max(seconds, 0.0))


STEP_S = 0.1
"""Longest time between two calls that is counted, if no other is given, s."""


class StallTimer:
    """Measures how long a value that ought to change has not changed; call it regularly.

    Args:
        now_ns: the host's monotonic clock; `time.monotonic_ns` if left out.
        step_s: longest time between two calls that is counted, s.
    """

    def __init__(self, now_ns: Callable[[], int] | None = None, step_s: float = STEP_S) -> None:
        self._now_ns, self._step_ns = now_ns, round(step_s * 1e9)
        self._mark: object = None
        self._last_ns = self._waited_ns = 0

    def waited_s(self, mark: object) -> float:
        """Return how long `mark` has been the same, s."""
        now_ns = (self._now_ns or time.monotonic_ns)()
        if mark != self._mark:
            self._mark, self._waited_ns = mark, 0
        else:
            self._waited_ns += min(now_ns - self._last_ns, self._step_ns)
        self._last_ns = now_ns
        return self._waited_ns / 1e9
