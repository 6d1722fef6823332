"""Wrenches of an arm's stream, which its thread adds and a force sensor reads."""

from __future__ import annotations

import threading
from collections import deque

from sliplab.rigs.core.pose_stream import BACKLOG_SAMPLES

Row = tuple[int, int, tuple[float, ...]]
"""Controller's clock and host's, ns; force in N and torque in N m."""


class WrenchLog:
    """Wrenches since the last read; thread-safe.

    Attributes:
        dropped: wrenches that were not read in time, since `start`.
    """

    def __init__(self) -> None:
        self._rows: deque[Row] = deque(maxlen=BACKLOG_SAMPLES)
        self._lock = threading.Lock()
        self.streaming = False
        self.dropped = 0

    def start(self) -> None:
        """Begin to keep wrenches."""
        with self._lock:
            self._rows.clear()
            self.dropped = 0
        self.streaming = True

    def stop(self) -> None:
        """Keep no more; those received can still be read."""
        self.streaming = False

    def add(self, t_ns: int, host_ns: int, values: tuple[float, ...]) -> None:
        """Take a wrench, in the thread of the arm's stream."""
        if self.streaming:
            with self._lock:
                self.dropped += len(self._rows) == BACKLOG_SAMPLES
                self._rows.append((t_ns, host_ns, values))

    def read(self) -> list[Row]:
        """Return the wrenches since the last call."""
        with self._lock:
            rows = list(self._rows)
            self._rows.clear()
        return rows
