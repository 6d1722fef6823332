"""Driver of the example frame camera.

The camera takes commands: `REGION`, a kind (`+` start, `-` stop) with columns and rows of a centred
region. It sends packets: `HEAD` and an image. One of kind `+` comes first, so that those after it
are known to belong to the new run. Its times are those of the beginning of the exposure.
"""

from __future__ import annotations

import socket
import struct
import threading
import time
from contextlib import suppress

import numpy as np

from sliplab.plugins.driver_kit.examples.frames import ExampleFramesSettings
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.stream_buffer import StreamBuffer
from sliplab.storage.streams import ClockReads, FrameChunk

DEVICE = "frame camera"
ANSWER_S = 1.0
"""Time limit of connecting and of every answer, s."""
START, STOP, IMAGE = b"+", b"-", b"I"
REGION = struct.Struct("<cHH")
HEAD = struct.Struct("<cqqHHB")
"""Kind, number, time in ns, rows, columns, and level of the sync line; then the image's bytes."""


class ExampleFrames:
    """A `sliplab.rigs.core.capabilities.FrameCamera`, open from the beginning. Raises RigError."""

    def __init__(self, settings: ExampleFramesSettings, px_per_mm: float) -> None:
        self.px_per_mm = px_per_mm
        self.mid_exposure_ns = round(settings.exposure_us * 500)
        self._region = 640, 480
        address = settings.host, settings.port
        try:
            self._socket = socket.create_connection(address, ANSWER_S)
        except OSError as error:
            raise RigError(DEVICE, f"{address}: {error}; check its power and network") from None
        self._socket.settimeout(None)  # a thread reads, and `read` notices silence
        self._buffer = StreamBuffer(DEVICE, settings.stall_s)
        self._answered = threading.Event()
        self._thread = threading.Thread(target=self._receive, name=DEVICE, daemon=True)
        self._thread.start()

    def set_region(self, width_px: int, height_px: int) -> None:
        """Read out only a centred region, from the next start on."""
        self._region = width_px, height_px

    def start(self) -> None:
        """Start grabbing; what came before is dropped. Raises RigError."""
        self._answered.clear()
        self._buffer.end()
        self._buffer.check()
        self._send(START)
        if not self._answered.wait(ANSWER_S):
            raise RigError(DEVICE, f"no answer within {ANSWER_S:g} s; restart it")
        self._buffer.check()

    def read(self) -> FrameChunk:
        """Frames since the last call. Raises RigError: it is gone or silent."""
        frames = self._buffer.take("frames")
        images = [image for image, *_ in frames]
        rows = np.array([row for _, *row in frames], np.int64).reshape(len(frames), 4)
        empty = np.empty((0, *self._region[::-1]), np.uint8)
        return FrameChunk(
            np.stack(images) if images else empty,
            rows[:, 0],
            rows[:, 1],
            rows[:, 2],
            rows[:, 3].astype(np.uint8),
        )

    def read_clock(self) -> ClockReads:
        """Not available. Raises RigError."""
        raise RigError(DEVICE, "its clock cannot be read by the host")

    def stop(self) -> None:
        """Stop grabbing; what has come can still be read."""
        self._buffer.end()
        with suppress(RigError):  # a camera that is gone streams no more
            self._send(STOP)

    def close(self) -> None:
        """Release the device; idempotent."""
        self._buffer.fail("it is closed")
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(ANSWER_S)

    # -- the wire ----------------------------------------------------------------------------

    def _send(self, command: bytes) -> None:
        try:
            self._socket.sendall(REGION.pack(command, *self._region))
        except OSError as error:
            raise RigError(DEVICE, f"{error}; look at its cable, then open it again") from None

    def _receive(self) -> None:
        """The receiving thread: it ends with the connection."""
        try:
            with self._socket.makefile("rb") as file:
                while len(head := file.read(HEAD.size)) == HEAD.size:
                    kind, number, t_ns, rows, columns, sync = HEAD.unpack(head)
                    if kind == START:
                        self._buffer.begin()
                        self._answered.set()
                        continue
                    pixels = np.frombuffer(file.read(rows * columns), np.uint8)
                    middle_ns = t_ns + self.mid_exposure_ns
                    row = (number, middle_ns, time.monotonic_ns(), sync)
                    frame = (pixels.reshape(rows, columns), *row)
                    self._buffer.add("frames", frame, np.array([middle_ns]))
            self._buffer.fail("the connection is gone")
        except (OSError, ValueError) as error:
            self._buffer.fail(str(error))
        self._answered.set()
