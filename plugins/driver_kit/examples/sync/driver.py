"""Driver of the example sync box.

The box answers each line with a line; times are microseconds of its clock, which `START` sets to 0:

    START 100.0 77 lfsr          STARTED 0           (rate in Hz, seed and name of the code)
    CLOCK                        CLOCK 1234567
    STOP                         STOPPED 1234567

Unasked it sends a line with each pulse, and with each exposure of the frame camera. `BOOT` says
that it has restarted:

    PULSE 10000
    EXPOSURE 10077
"""

from __future__ import annotations

import queue
import socket
import threading
import time
from contextlib import suppress

import numpy as np

from sliplab.plugins.driver_kit.examples.sync import ExampleSyncSettings
from sliplab.protocols.timing import Code
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import I64, ClockReads, PulseChunk

DEVICE = "sync box"
ANSWER_S = 0.5
"""Time limit of connecting and of every answer, s."""


class ExampleSync:
    """A `sliplab.rigs.core.capabilities.SyncBox`."""

    def __init__(self, settings: ExampleSyncSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._answers = queue.SimpleQueue[tuple[str, int]]()
        self._buffer = StreamBuffer(DEVICE, settings.stall_s)

    def connect(self) -> None:
        """Connect, again after a fault, and check that the box answers. Raises RigError."""
        self.close()
        address = self._settings.host, self._settings.port
        try:
            link = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{address}: {error}; check its power and network") from None
        link.settimeout(None)  # a thread reads; answers and silence have limits of their own
        self._socket, self._answers = link, queue.SimpleQueue()
        self._buffer = StreamBuffer(DEVICE, self._settings.stall_s)
        self._thread = threading.Thread(target=self._receive, args=(link,), daemon=True)
        self._thread.start()
        try:
            self._ask("CLOCK")
        except RigError:
            self.close()
            raise

    def start(self, rate_hz: float, seed: int, code: Code) -> None:
        """Start ticks and code; what came before is dropped. Raises RigError."""
        self._buffer.end()
        self._ask(f"START {rate_hz} {seed} {code}")

    def read_pulses(self) -> PulseChunk:
        """Pulses since the last call, ns since tick 0. Raises RigError: gone, silent, restarted."""
        return _joined(self._buffer.take("PULSE"))

    def read_exposures(self) -> PulseChunk:
        """Starts of exposures since the last call, ns since tick 0. Raises as `read_pulses`."""
        return _joined(self._buffer.take("EXPOSURE"))

    def read_clock(self) -> ClockReads:
        """Read the box's clock once. Raises RigError."""
        before_ns = time.monotonic_ns()
        device_ns, after_ns = self._ask("CLOCK")
        return ClockReads(*(np.array([row]) for row in (device_ns, before_ns, after_ns)))

    def stop(self) -> None:
        """Stop the ticks; the clock keeps running."""
        self._buffer.end()
        with suppress(RigError):  # a box that is gone ticks no more; the next read says so
            self._ask("STOP")

    def close(self) -> None:
        """Stop the ticks and release the device; idempotent."""
        self.stop()
        self._buffer.fail("it is closed")
        link, self._socket = self._socket, None
        if link is not None:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        if self._thread is not None:
            self._thread.join(ANSWER_S)

    # -- the wire ----------------------------------------------------------------------------

    def _ask(self, request: str) -> tuple[int, int]:
        """Return the time in the answer to a request, and that of its arrival, ns."""
        self._buffer.check()
        if self._socket is None:
            raise RigError(DEVICE, "it is not connected; connect it first")
        try:
            self._socket.sendall(f"{request}\n".encode())
            answer, at_ns = self._answers.get(timeout=ANSWER_S)
        except (OSError, queue.Empty):
            self._buffer.fail(f"no answer to {request}")  # a late one is not the next one's
            self._buffer.check()
            raise
        word, _, t_us = answer.partition(" ")
        if word == "ERROR":
            raise RigError(DEVICE, f"refused {request}: {t_us}")
        return int(t_us) * 1000, at_ns

    def _receive(self, link: socket.socket) -> None:
        """The receiving thread: it ends with the connection."""
        try:
            with link.makefile("r", encoding="ascii") as lines:
                for line in lines:
                    self._take(line.rstrip("\n"), time.monotonic_ns())
            self._buffer.fail("the connection is gone")
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))

    def _take(self, line: str, at_ns: int) -> None:
        word, _, t_us = line.partition(" ")
        if word in {"PULSE", "EXPOSURE"}:
            t_ns = np.array([int(t_us) * 1000])
            self._buffer.add(word, t_ns, t_ns)
        elif word == "BOOT":
            raise ValueError("it restarted")
        else:
            if word == "STARTED":
                self._buffer.begin()
            self._answers.put((line, at_ns))


def _joined(parts: list[I64]) -> PulseChunk:
    return PulseChunk(np.concatenate(parts) if parts else np.empty(0, np.int64))
