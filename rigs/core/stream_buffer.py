"""Buffer between the thread that receives a device's data and the rig that reads them.

A common part of drivers of cameras and sensors, as `threaded_arm` is of those of arms: times never
fall back, the buffer is bounded, and what goes wrong in the thread, or a silence, is a `RigError`
of the next read, once all that came before has been read.
"""

from __future__ import annotations

import threading
from typing import Any

from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.host_clock import OR_BUSY, StallTimer
from sliplab.storage.streams import I64

MOST_PARTS = 100_000
"""Parts of a stream that wait to be read; a device that sends more is a fault."""


class StreamBuffer:
    """Parts of one or more named streams of a device.

    Args:
        device: the device's part in the rig, for `RigError`.
        stall_s: silence of a running device that is a fault, s.
        most_mb: data that may wait to be read, MB; a device that sends more is a fault. Left out,
            only the number of parts is limited.
    """

    def __init__(self, device: str, stall_s: float, most_mb: float | None = None) -> None:
        self._device, self._stall_s, self._most_mb = device, stall_s, most_mb
        self._lock = threading.Lock()
        self._fault: str | None = None
        self._running = False
        self._forget()

    def _forget(self) -> None:
        self._parts: dict[str, list[Any]] = {}
        self._last: dict[str, int] = {}
        self._bytes: dict[str, int] = {}
        self._count = 0
        self._stall = StallTimer()

    def begin(self) -> None:
        """Begin a run: drop all that came before it."""
        with self._lock:
            self._forget()
            self._running = True

    def end(self) -> None:
        """End a run: received parts can still be read, new ones are dropped."""
        with self._lock:
            self._running = False

    def add(self, stream: str, part: Any, times: I64, nbytes: int = 0) -> None:
        """Add a part with its times, shape (n,), and its size; in the receiving thread.

        Raises:
            ValueError: times fall back or stop, or the buffer is not read.
        """
        with self._lock:
            if not self._running or not len(times):
                return
            last = self._last.get(stream, int(times[0]))
            if int(times[0]) < last or bool((times[1:] < times[:-1]).any()):
                raise ValueError(f"its clock fell back after {last}")
            waiting = self._parts.setdefault(stream, [])
            if len(waiting) == MOST_PARTS:
                raise ValueError(f"it was not read: {MOST_PARTS} packets are waiting")
            held = self._bytes.get(stream, 0) + nbytes
            if self._most_mb is not None and held > 1e6 * self._most_mb:
                raise ValueError(f"it was not read: {self._most_mb:g} MB are full")
            waiting.append(part)
            self._bytes[stream] = held
            if stream in self._last and int(times[-1]) == last:
                if self._stall.waited_s(self._count) > self._stall_s:
                    raise ValueError(f"its clock has stopped at {last}")
            else:  # data with constant times do not count as activity
                self._count += 1
            self._last[stream] = int(times[-1])

    def fail(self, why: str) -> None:
        """Record why the stream ended; the first reason is stored, later ones follow from it."""
        with self._lock:
            self._fault = self._fault or why

    def take(self, stream: str) -> list[Any]:
        """Remove and return the parts of a stream.

        Raises:
            RigError: the device has failed or fallen silent, and all parts were read.
        """
        with self._lock:
            taken = self._parts.pop(stream, [])
            self._bytes.pop(stream, None)
            if not taken and not self._parts:
                self._check()
        return taken

    def check(self) -> None:
        """Raise RigError if the device has failed or fallen silent."""
        with self._lock:
            self._check()

    def check_fault(self) -> None:
        """Raise RigError if the device has failed; a silent one may still take a command."""
        with self._lock:
            self._check_fault()

    def _check_fault(self) -> None:
        if self._fault is not None:
            raise RigError(self._device, f"{self._fault}; look at its cable, then open it again")

    def _check(self) -> None:
        self._check_fault()
        silent_s = self._stall.waited_s(self._count) if self._running else 0.0
        if silent_s > self._stall_s:
            raise RigError(self._device, f"silent for {silent_s:.1f} s; look at its cable{OR_BUSY}")
