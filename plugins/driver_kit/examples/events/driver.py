"""Driver of the example event camera.

The camera greets with its columns and rows (`SIZE`), takes the commands `+` (start) and `-` (stop),
and sends packets: `HEAD`, the kind of the items and their number, and the items. It repeats `+` in
the stream, so that what follows is known to belong to the new run. All numbers are little-endian.
"""

from __future__ import annotations

import socket
import struct
import threading
from contextlib import suppress

import numpy as np

from sliplab.plugins.driver_kit.examples.events import ExampleEventsSettings
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import EventChunk, PulseChunk

DEVICE = "event camera"
ANSWER_S = 1.0
"""Time limit of connecting and of every answer, s."""
SIZE, HEAD = struct.Struct("<HH"), struct.Struct("<cI")
START, STOP, EVENTS, EDGES = b"+", b"-", b"E", b"S"
EVENT = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""One event: time in us, column, row, polarity (1: brighter)."""
EDGE = np.dtype("<i8")
"""One rising edge of the sync input: time in us."""


class ExampleEvents:
    """A `sliplab.rigs.core.capabilities.EventCamera`, open from the beginning. Raises RigError."""

    def __init__(self, settings: ExampleEventsSettings) -> None:
        address = settings.host, settings.port
        try:
            self._socket = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{address}: {error}; check its power and network") from None
        self._file = self._socket.makefile("rb")
        try:
            self.width, self.height = SIZE.unpack(self._exactly(SIZE.size))
        except OSError as error:
            self._disconnect()
            raise RigError(DEVICE, f"{address} does not greet: {error}; restart it") from None
        self._socket.settimeout(None)  # from here on a thread reads, and `read` notices silence
        self._buffer = StreamBuffer(DEVICE, settings.stall_s)
        self._answered = threading.Event()
        self._thread = threading.Thread(target=self._receive, name=DEVICE, daemon=True)
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

    def read(self) -> EventChunk:
        """Events since the last call. Raises RigError: it is gone or silent."""
        return EventChunk.concatenate(self._buffer.take("events"))

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call, camera clock in ns. Raises RigError as `read`."""
        return PulseChunk.concatenate(self._buffer.take("pulses"))

    def stop(self) -> None:
        """Stop streaming; what has come can still be read."""
        self._buffer.end()
        with suppress(RigError):  # a camera that is gone streams no more
            self._send(STOP)

    def close(self) -> None:
        """Release the device; idempotent."""
        self._buffer.fail("it is closed")
        self._disconnect()
        self._thread.join(ANSWER_S)

    # -- the wire ----------------------------------------------------------------------------

    def _send(self, command: bytes) -> None:
        try:
            self._socket.sendall(command)
        except OSError as error:
            raise RigError(DEVICE, f"{error}; look at its cable, then open it again") from None

    def _receive(self) -> None:
        """The receiving thread: it ends with the connection."""
        try:
            while True:
                kind, count = HEAD.unpack(self._exactly(HEAD.size))
                if kind == EVENTS:
                    found = np.frombuffer(self._exactly(count * EVENT.itemsize), EVENT)
                    t_us = found["t"].astype(np.int64)
                    chunk = EventChunk(found["x"], found["y"], found["p"], t_us)
                    self._buffer.add("events", chunk, t_us)
                elif kind == EDGES:
                    edges = np.frombuffer(self._exactly(count * EDGE.itemsize), EDGE)
                    self._buffer.add("pulses", PulseChunk(edges * 1000), edges)
                elif kind == START:
                    self._buffer.begin()
                    self._answered.set()
                else:
                    raise ValueError(f"it sent a packet of kind {kind!r}")
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))
            self._answered.set()

    def _exactly(self, size: int) -> bytes:
        data = self._file.read(size)
        if len(data) < size:
            raise OSError("the connection is gone")
        return data

    def _disconnect(self) -> None:
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        with suppress(OSError):
            self._file.close()
        self._socket.close()
