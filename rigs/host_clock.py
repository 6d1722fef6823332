"""The clock of the computer that runs a real rig."""

from __future__ import annotations

import time


class HostClock:
    """A `rigs.capabilities.Clock`: the host's monotonic clock, by which drivers stamp arrivals."""

    def now_ns(self) -> int:
        """Nanoseconds since an arbitrary origin."""
        return time.monotonic_ns()

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass; a signal's handler runs at once."""
        time.sleep(max(seconds, 0.0))
