"""A fake USB camera: a pipe that OpenCV opens, into which a simulated scene's frames go.

The driver, its process and OpenCV's `VideoCapture` are the real ones; the kernel's driver and the
camera are not. Pictures are sent uncompressed, so that they arrive unchanged. A camera sends
pictures as soon as it is opened: the fake sends a black one.
"""

from __future__ import annotations

import errno
import os
import queue
import select
import shutil
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import av
import numpy as np

from sliplab.plugins.uvc.driver import UvcCamera
from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.driver import SceneFrames
from sliplab.rigs.core.host_clock import HostClock
from sliplab.storage.streams import U8, FrameChunk

POLL_S = 0.01
END_S = 2.0
"""Timeout for what the scene showed to pass through the pipe at a stop, s."""


class VideoPipe:
    """A named pipe with a video stream of grey pictures; one program may open it.

    Attributes:
        path: of the pipe.
        sent: number of pictures that were written since it was made.
    """

    def __init__(self, width: int, height: int, rate_hz: float) -> None:
        self._folder = Path(tempfile.mkdtemp(prefix="sliplab-uvc-"))
        self.path = str(self._folder / "video0")
        os.mkfifo(self.path)
        self._shape, self._rate = (height, width), max(round(rate_hz), 1)
        self._coming: queue.SimpleQueue[U8] = queue.SimpleQueue()
        self._closing = threading.Event()
        self.sent = 0
        self._thread = threading.Thread(target=self._write, name="fake USB camera", daemon=True)
        self._thread.start()

    def show(self, image: U8) -> None:
        """Send a picture; a smaller one is centred on a black one."""
        self._coming.put(image)

    def close(self) -> None:
        """Close the pipe, as a pulled cable would; safe to call more than once."""
        self._closing.set()
        self._thread.join(END_S)
        shutil.rmtree(self._folder, ignore_errors=True)

    def write(self, data: bytes) -> int:
        """Write to the pipe, which is full until it is read; called by the container."""
        rest = memoryview(data)
        while rest:
            if self._closing.is_set():
                raise BrokenPipeError
            if select.select([], [self._handle], [], POLL_S)[1]:
                rest = rest[os.write(self._handle, rest) :]
        return len(data)

    def _write(self) -> None:
        opened = self._open()
        if opened is None:
            return
        self._handle = opened
        try:
            with (
                suppress(OSError),
                av.open(self, "w", format="avi", options={"flush_packets": "1"}) as container,
            ):
                stream = container.add_stream("rawvideo", rate=self._rate)
                stream.height, stream.width = self._shape
                stream.pix_fmt = "bgr24"
                image: U8 | None = np.zeros(self._shape, np.uint8)
                while not self._closing.is_set():
                    if image is not None:
                        frame = av.VideoFrame.from_ndarray(self._whole(image), format="bgr24")
                        for packet in stream.encode(frame):
                            container.mux(packet)
                        self.sent += 1
                    try:
                        image = self._coming.get(timeout=POLL_S)
                    except queue.Empty:
                        image = None
        finally:
            os.close(opened)

    def _open(self) -> int | None:
        """Return the pipe's descriptor once it has a reader; None if it was closed before."""
        while not self._closing.wait(POLL_S):
            try:
                return os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:
                if error.errno != errno.ENXIO:
                    return None
        return None

    def _whole(self, image: U8) -> U8:
        height, width = self._shape
        top, left = (height - image.shape[0]) // 2, (width - image.shape[1]) // 2
        whole = np.zeros((height, width, 3), np.uint8)
        whole[top : top + image.shape[0], left : left + image.shape[1]] = image[..., None]
        return whole


class FedCamera(UvcCamera):
    """The driver on a pipe that a scene feeds while the camera is started."""

    def __init__(
        self, settings: UvcSettings, px_per_mm: float, scene: SceneFrames, mid_exposure_ns: int = 0
    ) -> None:
        self._scene = scene
        self._pipe = VideoPipe(settings.width_px, settings.height_px, settings.rate_hz)
        self._shown = 0
        self._ended = threading.Event()
        try:
            super().__init__(settings.model_copy(update={"device": self._pipe.path}), px_per_mm)
        except BaseException:
            self._pipe.close()
            raise

    def start(self) -> None:
        """Start the driver, then the scene."""
        super().start()
        self._shown = 0
        self._ended.clear()
        self._scene.grab(*self._size, self._show)

    def stop(self) -> None:
        """Stop the scene, let its last frames pass, and stop the driver."""
        if self._running:
            self._scene.stop_grabbing()
            self._ended.wait(END_S)
            clock, end = HostClock(), time.monotonic() + END_S
            while self._fault is None and self._call("grabbed") < self._shown:
                if time.monotonic() > end:
                    break
                clock.wait(POLL_S)
        super().stop()

    def unplug(self) -> None:
        """Pull the cable."""
        self._pipe.close()

    def close(self) -> None:
        """Close the driver, and the pipe."""
        super().close()
        self._pipe.close()

    def _show(self, frames: FrameChunk) -> None:
        """Send frames through the pipe; an empty chunk ends them."""
        if not len(frames.number):
            self._ended.set()
        for image in frames.images:
            self._shown += 1
            self._pipe.show(image)
