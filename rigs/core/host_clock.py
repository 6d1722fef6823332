"""The clock of the computer that runs a real rig."""

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
