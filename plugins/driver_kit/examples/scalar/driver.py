"""Driver of the example scalar sensor.

The sensor takes the commands `RUN` and `STOP`. It answers `RUN` with `RUNNING`, so that readings
after it are known to belong to the new run; each reading is a line with a number.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import numpy as np
import serial

from sliplab.plugins.driver_kit.examples.scalar import ExampleScalarSettings
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import ScalarChunk

DEVICE = "scalar sensor"
ANSWER_S = 1.0
"""Time limit of every answer, s."""
READ_S = 0.1
"""Period at which the reading thread looks whether to end, s."""


class ExampleScalar:
    """A `sliplab.rigs.core.capabilities.ScalarSensor`; times are those of arrival."""

    unit = "degC"

    def __init__(self, settings: ExampleScalarSettings) -> None:
        self._settings = settings
        self._port: serial.Serial | None = None
        self._thread: threading.Thread | None = None
        self._answered, self._ending = threading.Event(), threading.Event()
        self._buffer = StreamBuffer(DEVICE, settings.stall_s)

    def connect(self) -> None:
        """Open the port, again after a fault. Raises RigError."""
        self.close()
        port, baud = self._settings.port, self._settings.baud
        try:
            self._port = serial.Serial(
                port, baud, timeout=READ_S, write_timeout=ANSWER_S, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise RigError(DEVICE, f"cannot open {port}: {error}; check its cable") from None
        self._ending.clear()
        self._buffer = StreamBuffer(DEVICE, self._settings.stall_s)
        self._thread = threading.Thread(target=self._receive, args=(self._port,), daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Start streaming; what came before is dropped. Raises RigError."""
        self._answered.clear()
        self._buffer.end()
        self._buffer.check()
        self._send("RUN")
        if not self._answered.wait(ANSWER_S):
            raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; restart it")
        self._buffer.check()

    def read(self) -> ScalarChunk:
        """Readings since the last call. Raises RigError: gone or silent."""
        parts = self._buffer.take("value")
        t_ns = np.array([host_ns for host_ns, _ in parts], np.int64)
        return ScalarChunk(t_ns, t_ns, np.array([value for _, value in parts]), self.unit)

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""
        self._buffer.end()
        with suppress(RigError):  # a sensor that is gone streams no more
            self._send("STOP")

    def close(self) -> None:
        """Release the device; idempotent."""
        self._buffer.fail("it is closed")
        self._ending.set()
        if self._thread is not None:
            self._thread.join(ANSWER_S)
        port, self._port = self._port, None
        if port is not None:
            port.close()

    # -- the wire ----------------------------------------------------------------------------

    def _send(self, command: str) -> None:
        if self._port is None:
            raise RigError(DEVICE, "it is not connected; connect it first")
        try:
            self._port.write(f"{command}\n".encode())
        except OSError as error:
            raise RigError(DEVICE, f"{error}; look at its cable, then connect it again") from None

    def _receive(self, port: serial.Serial) -> None:
        """The reading thread."""
        rest = b""
        try:
            while not self._ending.is_set():
                *lines, rest = (rest + port.read(max(1, port.in_waiting))).split(b"\n")
                for line in lines:
                    self._take(line.decode("ascii"), time.monotonic_ns())
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))
        self._answered.set()

    def _take(self, line: str, host_ns: int) -> None:
        if line == "RUNNING":
            self._buffer.begin()
            self._answered.set()
        else:
            self._buffer.add("value", (host_ns, float(line)), np.array([host_ns]))
