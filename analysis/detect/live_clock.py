"""The camera's clock as a running program knows it: by the freshest thing that has arrived.

Nothing is fitted while a stream runs. What arrives with the least delay bounds the camera's clock
from below, so the freshest arrival of the last seconds counts as having taken no time; the part
of the delay that no arrival is without cannot be seen from here.
"""

from __future__ import annotations

SPAN_NS = 5_000_000_000
"""How long an arrival counts at least; twice that at most. 100 ppm of drift are 1 ms then."""


class FreshestArrival:
    """Camera time against the host's monotonic clock."""

    def __init__(self) -> None:
        self._began_ns: int | None = None
        self._before: int | None = None
        self._here: int | None = None

    def observe(self, camera_us: int, host_ns: int) -> None:
        """Something that happened at `camera_us` was here at `host_ns`."""
        ahead_ns = camera_us * 1000 - host_ns
        if self._began_ns is None or host_ns - self._began_ns >= SPAN_NS:
            self._began_ns, self._before, self._here = host_ns, self._here, ahead_ns
        elif self._here is None or ahead_ns > self._here:
            self._here = ahead_ns

    def camera_us(self, host_ns: int) -> int | None:
        """What the camera's clock has come to, at the least; None before the first arrival."""
        ahead_ns = self._ahead_ns
        return None if ahead_ns is None else (host_ns + ahead_ns) // 1000

    def host_ns(self, camera_us: int) -> int | None:
        """When a thing of that time could have been here at the earliest."""
        ahead_ns = self._ahead_ns
        return None if ahead_ns is None else camera_us * 1000 - ahead_ns

    @property
    def _ahead_ns(self) -> int | None:
        if self._here is None:
            return None
        return self._here if self._before is None else max(self._before, self._here)
