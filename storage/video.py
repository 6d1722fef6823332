"""Frames as lossless video: FFV1 in Matroska, every frame a key frame, the same bytes every time.

Matroska files carry random identifiers and dates unless the muxer is told not to; with the
bit-exact flag two identical videos are two identical files, so checksums mean something.
Encoding runs in its own thread behind a bounded queue: a full queue is back-pressure that the
caller sees as time, never as a lost frame.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from pathlib import Path

import av
import numpy as np

from storage.streams import U8

CODEC_OPTIONS = {"level": "3", "coder": "rice", "context": "0", "g": "1", "slices": "9"}
_QUEUE_FRAMES = 64
_PUT_TIMEOUT_S = 60.0


class VideoWriter:
    """Writes grey frames of one size; `close` returns when every frame is in the file."""

    def __init__(self, path: Path, width: int, height: int, rate_hz: int, threads: int = 2) -> None:
        self.width, self.height = width, height
        self.frames = 0
        self._container = av.open(
            str(path), "w", format="matroska", options={"fflags": "+bitexact"}
        )
        self._stream = self._container.add_stream("ffv1", rate=rate_hz, options=CODEC_OPTIONS)
        self._stream.width, self._stream.height = width, height
        self._stream.pix_fmt = "gray"
        self._stream.codec_context.thread_count = threads
        self._stream.codec_context.thread_type = "SLICE"
        self._stream.codec_context.flags |= av.codec.context.Flags.bitexact
        self._queue: queue.Queue[U8 | None] = queue.Queue(_QUEUE_FRAMES)
        self._error: Exception | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._encode, name="video encoder", daemon=True)
        self._thread.start()

    def write(self, images: U8) -> None:
        """Append frames of shape (n, height, width), grey, uint8.

        Raises:
            ValueError: another shape or type than the file's.
            RuntimeError: the encoder failed or stands still.
        """
        if images.dtype != np.uint8 or images.shape[1:] != (self.height, self.width):
            raise ValueError(
                f"frames of {images.dtype} {images.shape[1:]} do not fit a video of uint8 "
                f"({self.height}, {self.width})"
            )
        for image in images:
            self._check()
            try:
                self._queue.put(np.ascontiguousarray(image), timeout=_PUT_TIMEOUT_S)
            except queue.Full:
                raise RuntimeError("the video encoder has stood still for a minute") from None
            self.frames += 1

    def close(self) -> None:
        """Encode what is queued, close the file, and raise what the encoder raised."""
        if self._closed:
            return
        self._closed = True
        self._queue.put(None, timeout=_PUT_TIMEOUT_S)
        self._thread.join(timeout=10 * _PUT_TIMEOUT_S)
        self._container.close()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise RuntimeError(f"the video encoder failed: {self._error}") from self._error

    def _encode(self) -> None:
        while (image := self._queue.get()) is not None:
            if self._error is not None:
                continue  # drain, so that the writer is never blocked by a dead encoder
            try:
                frame = av.VideoFrame.from_ndarray(image, format="gray")
                for packet in self._stream.encode(frame):
                    self._container.mux(packet)
            except Exception as error:
                self._error = error
        if self._error is None:
            try:
                for packet in self._stream.encode():
                    self._container.mux(packet)
            except Exception as error:
                self._error = error


def read_frames(path: Path, threads: int = 1) -> Iterator[U8]:
    """Decode a video frame by frame: uint8 arrays of shape (height, width)."""
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = threads
        stream.codec_context.thread_type = "FRAME" if threads > 1 else "SLICE"
        for frame in container.decode(stream):
            yield frame.to_ndarray(format="gray")


def read_frame(path: Path, index: int) -> U8:
    """Decode one frame; every frame is a key frame, so only its packet is decoded.

    Raises:
        IndexError: the video has fewer frames.
    """
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        for number, packet in enumerate(container.demux(stream)):
            if number == index and packet.size:
                return next(iter(packet.decode())).to_ndarray(format="gray")  # type: ignore[no-any-return]
    raise IndexError(f"{path}: has no frame {index}")


def count_frames(path: Path) -> int:
    """Number of frames, counted by packets without decoding."""
    with av.open(str(path)) as container:
        return sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)
