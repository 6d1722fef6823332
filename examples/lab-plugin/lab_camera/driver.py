"""Driver of the lab camera; `lab_camera.wire` has its bytes."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

import numpy as np

from lab_camera import LabCameraSettings, wire
from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import EventChunk, PulseChunk

DEVICE = "event camera"
ANSWER_S = 2.0
"""Time limit of connecting, and of every answer, s."""


class LabCamera:
    """A `sliplab.rigs.core.capabilities.EventCamera`; it is open from the beginning.

    Raises:
        RigError: nothing there, or something else than such a camera.
    """

    def __init__(self, settings: LabCameraSettings) -> None:
        self._settings = settings
        self._where = f"{settings.host}:{settings.port}"
        try:
            self._socket = socket.create_connection((settings.host, settings.port), ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{self._where}: {error}; check its power and network") from None
        try:
            greeting = self._exactly(wire.GREETING.size)
            magic, self.width, self.height, serial = wire.GREETING.unpack(greeting)
            if magic != wire.MAGIC:
                raise ValueError(f"it greets with {magic!r}")
        except (OSError, ValueError) as error:
            self._socket.close()
            raise RigError(DEVICE, f"{self._where} is no lab camera: {error}") from None
        self._serial = serial.rstrip(b"\0").decode("ascii", "replace")
        self._socket.settimeout(None)  # from here on a thread reads, and `read` notices silence
        self._buffer = StreamBuffer(DEVICE, settings.stall_s, settings.buffer_mb)
        self._changed = threading.Condition()
        self._running = self._ended = False
        self._answers = 0
        self._thread = threading.Thread(target=self._run, name=self._where, daemon=True)
        self._thread.start()

    def start(self) -> None:
        """Begin to stream; what came before is dropped. Takes at most `ANSWER_S`.

        Raises:
            RigError: the camera is gone, or does not answer.
        """
        self._command(wire.STARTED)
        self._running = True

    def read(self) -> EventChunk:
        """Return the events since the last call.

        Raises:
            RigError: the camera is gone, silent, set its clock back or was not read in time, and
                all that came before was read.
        """
        return EventChunk.concatenate(self._buffer.take("events"))

    def read_pulses(self) -> PulseChunk:
        """Return the sync pulses since the last call, camera clock in ns. Raises as `read`."""
        return PulseChunk.concatenate(self._buffer.take("pulses"))

    def stop(self) -> None:
        """Stop streaming; what has come can still be read. Takes at most `ANSWER_S`."""
        if self._running:
            self._running = False
            with suppress(RigError):  # a camera that is gone streams no more
                self._command(wire.STOPPED)
            self._buffer.end()

    def close(self) -> None:
        """Release the device; idempotent."""
        self.stop()
        self._buffer.fail("it is closed")
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(ANSWER_S)

    def health(self) -> DeviceHealth:
        """Return what the camera said of itself. Raises RigError: it is gone."""
        self._buffer.check_fault()
        return DeviceHealth(
            device=DEVICE,
            model="lab camera",
            serial=self._serial,
            firmware=UNKNOWN,
            temperature_c=None,
            clock="its own, 1 us",
            notes=(f"{self.width} x {self.height} px",),
        )

    # ----------------------------------------------------------------------------------------

    def _command(self, command: bytes) -> None:
        """Give a command and wait for its answer in the stream. Raises RigError."""
        self._buffer.check_fault()
        with self._changed:
            seen = self._answers
            try:
                self._socket.sendall(command)
            except OSError as error:
                raise RigError(DEVICE, f"{error}; look at its cable and open it again") from None
            if not self._changed.wait_for(lambda: self._answers > seen or self._ended, ANSWER_S):
                raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; look at it")
        self._buffer.check_fault()

    def _run(self) -> None:
        """The reading thread: it ends with the connection."""
        try:
            while True:
                kind, count = wire.HEAD.unpack(self._exactly(wire.HEAD.size))
                self._take(kind, count)
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _take(self, kind: bytes, count: int) -> None:
        """Take a packet. Raises ValueError: it is none, or a clock fell back."""
        if kind not in {wire.EVENTS, wire.EDGES, wire.STARTED, wire.STOPPED}:
            raise ValueError(f"it sent a packet of kind {kind!r}")
        if count > wire.MOST_ITEMS:
            raise ValueError(f"it sent a packet of {count} items")
        size = {wire.EVENTS: wire.EVENT.itemsize, wire.EDGES: wire.EDGE.itemsize}.get(kind, 0)
        data = self._exactly(count * size)
        if kind == wire.EVENTS:
            found = np.frombuffer(data, wire.EVENT)
            t_us = found["t"].astype(np.int64)
            chunk = EventChunk(found["x"].copy(), found["y"].copy(), found["p"].copy(), t_us)
            self._buffer.add("events", chunk, t_us, len(data))
        elif kind == wire.EDGES:
            edges_us = np.frombuffer(data, wire.EDGE).astype(np.int64)
            self._buffer.add("pulses", PulseChunk(edges_us * 1000), edges_us, len(data))
        else:
            if kind == wire.STARTED:
                self._buffer.begin()
            with self._changed:
                self._answers += 1
                self._changed.notify_all()

    def _exactly(self, size: int) -> bytes:
        """Return so many bytes. Raises OSError: the connection is gone."""
        data = bytearray(size)
        view = memoryview(data)
        while len(view):
            got = self._socket.recv_into(view)
            if not got:
                raise OSError("the connection is gone")
            view = view[got:]
        return bytes(data)
