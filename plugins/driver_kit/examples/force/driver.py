"""Driver of the example force sensor.

The sensor takes the commands `+` (start), `-` (stop) and `0` (take the present load for zero), and
sends one `SAMPLE` after the other. One of kind `+` comes first, so that those after it are known to
belong to the new run; one of kind `!` says that the load is out of range.
"""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress
from typing import Literal

import numpy as np
import numpy.typing as npt

from sliplab.plugins.driver_kit.examples.force import ExampleForceSettings
from sliplab.protocols.timing import ForceGrade
from sliplab.rigs.core.capabilities import Mounting, RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import WrenchChunk

DEVICE = "force sensor"
ANSWER_S = 1.0
"""Time limit of connecting and of every answer, s."""
START, STOP, ZERO, LOAD, OVERLOAD = b"+", b"-", b"0", b"W", b"!"
SAMPLE = np.dtype([("kind", "S1"), ("t", "<i8"), ("force", "<f8", 3), ("torque", "<f8", 3)])
"""One sample: time in ns, force in N, torque in N m."""


class ExampleForce:
    """A `sliplab.rigs.core.capabilities.ForceSensor`."""

    mounting = Mounting()
    grade: ForceGrade = "host time"
    zeroing: Literal["trial", "session", "never"] = "trial"

    def __init__(self, settings: ExampleForceSettings) -> None:
        self._settings = settings
        self._socket: socket.socket | None = None
        self._thread: threading.Thread | None = None
        self._answered = threading.Event()
        self._buffer = StreamBuffer(DEVICE, settings.stall_s)

    def connect(self) -> None:
        """Open the connection, again after a fault; at most `ANSWER_S`. Raises RigError."""
        self.close()
        address = self._settings.host, self._settings.port
        try:
            link = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{address}: {error}; check its power and network") from None
        link.settimeout(None)  # a thread reads, and `read` notices silence
        self._socket, self._buffer = link, StreamBuffer(DEVICE, self._settings.stall_s)
        self._thread = threading.Thread(target=self._receive, args=(link,), daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Start streaming; what came before is dropped. Raises RigError."""
        self._answered.clear()
        self._buffer.end()
        self._buffer.check()
        self._send(START)
        if not self._answered.wait(ANSWER_S):
            raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; restart it")
        self._buffer.check()

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call. Raises RigError: gone, silent or overloaded."""
        parts = self._buffer.take("load")
        if not parts:
            return WrenchChunk.empty()
        found = np.concatenate([sample for sample, _ in parts])
        host_ns = np.array([host_ns for _, host_ns in parts], np.int64)
        return WrenchChunk(found["t"].astype(np.int64), host_ns, found["force"], found["torque"])

    def zero(self) -> None:
        """Take the present load for zero from now on. Raises RigError."""
        self._send(ZERO)

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""
        self._buffer.end()
        with suppress(RigError):  # a sensor that is gone streams no more
            self._send(STOP)

    def close(self) -> None:
        """Release the device; idempotent."""
        self._buffer.fail("it is closed")
        link, self._socket = self._socket, None
        if link is not None:
            with suppress(OSError):
                link.shutdown(socket.SHUT_RDWR)
            link.close()
        if self._thread is not None:
            self._thread.join(ANSWER_S)

    # -- the wire ----------------------------------------------------------------------------

    def _send(self, command: bytes) -> None:
        if self._socket is None:
            raise RigError(DEVICE, "it is not connected; connect it first")
        try:
            self._socket.sendall(command)
        except OSError as error:
            raise RigError(DEVICE, f"{error}; look at its cable, then connect it again") from None

    def _receive(self, link: socket.socket) -> None:
        """The receiving thread: it ends with the connection."""
        try:
            with link.makefile("rb") as file:
                while len(data := file.read(SAMPLE.itemsize)) == SAMPLE.itemsize:
                    self._take(np.frombuffer(data, SAMPLE))
            self._buffer.fail("the connection is gone")
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))
        self._answered.set()

    def _take(self, sample: npt.NDArray[np.void]) -> None:
        kind = sample["kind"][0]
        if kind == START:
            self._buffer.begin()
            self._answered.set()
        elif kind == LOAD:
            self._buffer.add("load", (sample, time.monotonic_ns()), sample["t"])
        else:
            raise ValueError("the load is out of range" if kind == OVERLOAD else f"kind {kind!r}")
