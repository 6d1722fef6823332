"""Driver of the lab camera; `lab_camera.wire` has its bytes."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress

import numpy as np

from lab_camera import LabCameraSettings, wire
from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.rigs.core.host_clock import StallTimer
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
        self._socket.settimeout(
            None
        )  # from here on a thread reads, and silence is judged by `read`
        self._changed = threading.Condition()
        self._fault: RigError | None = None
        self._running = self._closed = False
        self._answers = 0
        self._forget()
        self._thread = threading.Thread(target=self._run, name=self._where, daemon=True)
        self._thread.start()

    def _forget(self) -> None:
        self._events: list[EventChunk] = []
        self._pulses: list[int] = []
        self._held = self._packets = 0
        self._last_us = self._last_pulse_us = -(1 << 62)
        self._stall = StallTimer()

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
        with self._changed:
            parts, self._events, self._held = self._events, [], 0
            self._check(news=bool(parts))
        return EventChunk.joined(parts)

    def read_pulses(self) -> PulseChunk:
        """Return the sync pulses since the last call, camera clock in ns. Raises as `read`."""
        with self._changed:
            pulses, self._pulses = self._pulses, []
            self._check(news=bool(pulses or self._events))
        return PulseChunk(np.array(pulses, np.int64) * 1000)

    def stop(self) -> None:
        """Stop streaming; what has come can still be read. Takes at most `ANSWER_S`."""
        if self._running:
            self._running = False
            with suppress(RigError):  # a camera that is gone streams no more
                self._command(wire.STOPPED)

    def close(self) -> None:
        """Give the device back; at any time and more than once."""
        self.stop()
        self._closed = True
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(ANSWER_S)

    def health(self) -> DeviceHealth:
        """Return what the camera said of itself. Raises RigError: it is gone."""
        with self._changed:
            self._check_fault()
        return DeviceHealth(
            device=DEVICE, model="lab camera", serial=self._serial, firmware=UNKNOWN,
            temperature_c=None, clock="its own, 1 us", notes=(f"{self.width} x {self.height} px",),
        )  # fmt: skip

    # ----------------------------------------------------------------------------------------

    def _check_fault(self) -> None:
        if self._closed:
            raise RigError(DEVICE, "it is closed; open it again")
        if self._fault is not None:
            raise self._fault

    def _check(self, news: bool) -> None:
        """Raise what is wrong, once all that came before was read."""
        if news:
            return
        self._check_fault()
        if self._running:
            silent_s = self._stall.waited_s(self._packets)
            if silent_s > self._settings.stall_s:
                raise RigError(DEVICE, f"silent for {silent_s:.1f} s; look at it and its cable")

    def _command(self, command: bytes) -> None:
        """Give a command and wait for its answer in the stream. Raises RigError."""
        with self._changed:
            self._check_fault()
            seen = self._answers
            try:
                self._socket.sendall(command)
            except OSError as error:
                raise RigError(DEVICE, f"{error}; look at its cable and open it again") from None

            def answered() -> bool:
                return self._answers > seen or self._fault is not None

            if not self._changed.wait_for(answered, ANSWER_S):
                raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; look at it")
            self._check_fault()

    def _run(self) -> None:
        """The reading thread: it ends with the connection."""
        why = "reading ended"
        try:
            while True:
                kind, count = wire.HEAD.unpack(self._exactly(wire.HEAD.size))
                self._take(kind, count)
        except (OSError, ValueError) as error:
            why = str(error)
        with self._changed:
            if self._fault is None:
                self._fault = RigError(DEVICE, f"{why}; look at its cable and open it again")
            self._changed.notify_all()

    def _take(self, kind: bytes, count: int) -> None:
        """Take a packet. Raises ValueError: it is none, or a clock fell back."""
        if kind not in {wire.EVENTS, wire.EDGES, wire.STARTED, wire.STOPPED}:
            raise ValueError(f"it sent a packet of kind {kind!r}")
        if count > wire.MOST_ITEMS:
            raise ValueError(f"it sent a packet of {count} items")
        size = {wire.EVENTS: wire.EVENT.itemsize, wire.EDGES: wire.EDGE.itemsize}.get(kind, 0)
        data = self._exactly(count * size)
        with self._changed:
            self._packets += 1
            if kind == wire.EVENTS:
                self._take_events(np.frombuffer(data, wire.EVENT))
            elif kind == wire.EDGES:
                self._take_edges(np.frombuffer(data, wire.EDGE).tolist())
            else:
                if kind == wire.STARTED:
                    self._forget()
                self._answers += 1
            self._changed.notify_all()

    def _take_events(self, found: np.ndarray) -> None:  # type: ignore[type-arg]
        t_us = found["t"].astype(np.int64)
        if not len(t_us):
            return
        if int(np.diff(t_us, prepend=max(self._last_us, int(t_us[0]) - 1)).min()) < 0:
            raise ValueError(f"its clock fell back after {self._last_us} us")
        self._held += found.nbytes
        if self._held > self._settings.buffer_mb * 1e6:
            text = f"nobody read for so long that {self._settings.buffer_mb:g} MB are full"
            raise ValueError(text)
        self._last_us = int(t_us[-1])
        self._events.append(
            EventChunk(found["x"].copy(), found["y"].copy(), found["p"].copy(), t_us)
        )

    def _take_edges(self, edges_us: list[int]) -> None:
        for at_us in edges_us:
            if at_us < self._last_pulse_us:
                raise ValueError(f"its clock fell back after the pulse at {self._last_pulse_us} us")
            self._last_pulse_us = at_us
            self._pulses.append(at_us)

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
