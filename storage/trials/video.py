"""Lossless video of frames: FFV1 in Matroska, every frame a key frame, reproducible byte for byte.

Matroska files carry random identifiers and dates unless the muxer is configured not to; with the
bit-exact flag two identical videos are two identical files, so checksums mean something.
Encoding runs in separate threads behind bounded queues: a full queue is back-pressure that the
caller sees as time, never as a lost frame. Frames are coded independently, so every thread has its
own encoder and takes every n-th frame: that costs a quarter less processor time than letting one
encoder share the slices of each frame among threads.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sliplab.protocols.later import Later
from sliplab.storage.streams import I64, U8

if TYPE_CHECKING:
    import av
else:
    av = Later("av")

CODEC_OPTIONS = {"level": "3", "coder": "rice", "context": "0", "g": "1", "slices": "9"}
_AT_ONCE = {"cluster_time_limit": "1", "flush_packets": "1"}
"""A cluster a frame: Matroska's writer holds a cluster back until the next one begins."""
_INDEXED = 32
"""Of so many frames of a video that is written for hours one is in Matroska's index, which its
writer keeps in memory: it takes the frames that are marked as key frames."""
_QUEUE_FRAMES = 32
_PUT_TIMEOUT_S = 60.0


def video_url(path: Path) -> str:
    """Return a file as FFmpeg opens it: what precedes a colon in its name is no protocol."""
    return f"file:{path}"


class VideoWriter:
    """Writes grey frames of one size; `close` returns when every frame is in the file.

    The file does not depend on the number of threads.

    Args:
        guarded: write each frame when the next one comes, for a program that may be killed.
    """

    def __init__(
        self,
        path: Path,
        width: int,
        height: int,
        rate_hz: int,
        threads: int = 2,
        guarded: bool = False,
    ) -> None:
        self.width, self.height = width, height
        self.frames = 0
        self._time_base = Fraction(1, rate_hz)
        self._indexed = _INDEXED if guarded else 1
        options = {"fflags": "+bitexact"} | (_AT_ONCE if guarded else {})
        self._container = av.open(video_url(path), "w", format="matroska", options=options)
        self._stream = self._container.add_stream("ffv1", rate=rate_hz, options=CODEC_OPTIONS)
        encoders = [self._stream.codec_context]
        encoders += [av.CodecContext.create("ffv1", "w") for _ in range(threads - 1)]
        for encoder in encoders:
            encoder.width, encoder.height, encoder.pix_fmt = width, height, "gray"
            encoder.time_base, encoder.framerate = self._time_base, Fraction(rate_hz)
            encoder.options, encoder.thread_count = CODEC_OPTIONS, 1
            encoder.flags |= av.codec.context.Flags.bitexact
            encoder.flags |= av.codec.context.Flags.global_header
        self._error: Exception | None = None
        self._closed = False
        self._muxed = 0
        self._turn = threading.Condition()
        self._queues: list[queue.Queue[tuple[int, U8] | None]] = [
            queue.Queue(_QUEUE_FRAMES) for _ in encoders
        ]
        self._threads = [
            threading.Thread(
                target=self._encode, args=pair, name=f"video encoder {index}", daemon=True
            )
            for index, pair in enumerate(zip(encoders, self._queues, strict=True))
        ]
        for thread in self._threads:
            thread.start()

    @property
    def muxed(self) -> int:
        """Frames that were handed to the file."""
        return self._muxed

    def write(self, images: U8) -> None:
        """Append frames of shape (n, height, width), grey, uint8.

        Raises:
            ValueError: another shape or type than the file's.
            RuntimeError: an encoder failed or hangs.
        """
        if images.dtype != np.uint8 or images.shape[1:] != (self.height, self.width):
            raise ValueError(
                f"frames of {images.dtype} {images.shape[1:]} do not fit a video of uint8 "
                f"({self.height}, {self.width})"
            )
        for image in images:
            self._check()
            mine = self._queues[self.frames % len(self._queues)]
            try:
                mine.put((self.frames, np.ascontiguousarray(image)), timeout=_PUT_TIMEOUT_S)
            except queue.Full:
                raise RuntimeError("the video encoder has hung for a minute") from None
            self.frames += 1

    def close(self) -> None:
        """Encode queued frames, close the file, and re-raise an encoder's error."""
        if self._closed:
            return
        self._closed = True
        for waiting in self._queues:
            waiting.put(None, timeout=_PUT_TIMEOUT_S)
        for thread in self._threads:
            thread.join(timeout=10 * _PUT_TIMEOUT_S)
        self._container.close()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise RuntimeError(f"the video encoder failed: {self._error}") from self._error

    def _encode(self, encoder: Any, waiting: queue.Queue[tuple[int, U8] | None]) -> None:
        """Encode queued frames in one thread, and write each frame in its turn."""
        while (item := waiting.get()) is not None:
            if self._error is not None:
                continue  # drain, so that the writer is never blocked by a dead encoder
            index, image = item
            try:
                frame = av.VideoFrame.from_numpy_buffer(image, format="gray")  # no copy
                frame.pts, frame.time_base = index, self._time_base
                packets = encoder.encode(frame)
                with self._turn:
                    while self._muxed != index and self._error is None:
                        self._turn.wait()
                    for packet in packets if self._error is None else ():
                        packet.stream = self._stream
                        packet.is_keyframe = index % self._indexed == 0
                        self._container.mux(packet)
                    self._muxed += 1
                    self._turn.notify_all()
            except Exception as error:
                with self._turn:
                    self._error = error
                    self._turn.notify_all()


def read_frames(path: Path, threads: int = 1) -> Iterator[U8]:
    """Decode a video frame by frame: uint8 arrays of shape (height, width)."""
    with av.open(video_url(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.thread_count = threads
        stream.codec_context.thread_type = "FRAME" if threads > 1 else "SLICE"
        for frame in container.decode(stream):
            yield frame.to_ndarray(format="gray")


def copy_frames(source: Path, target: Path, numbers: I64, rate_hz: int) -> None:
    """Write frames of a video at a fixed rate, without decoding, as FFV1 in MP4.

    Every frame is a key frame, so a packet may be left out or come again.

    Args:
        numbers: (n,) number in `source` of each frame, ascending.

    Raises:
        IndexError: `source` has fewer frames.
    """
    base, due = Fraction(1, rate_hz), iter(enumerate(numbers.tolist()))
    options = {"fflags": "+bitexact"}
    with (
        av.open(video_url(source)) as read,
        av.open(video_url(target), "w", format="mp4", options=options) as written,
    ):
        stream = written.add_stream_from_template(read.streams.video[0])
        stream.time_base = base
        at, number = next(due, (0, None))
        for here, source_packet in enumerate(read.demux(video=0)):
            while number == here and source_packet.size:
                packet = av.Packet(source_packet)
                packet.stream, packet.time_base, packet.is_keyframe = stream, base, True
                packet.pts, packet.dts, packet.duration = at, at, 1
                written.mux(packet)
                at, number = next(due, (0, None))
    if number is not None:
        raise IndexError(f"{source}: has no frame {number}")


def read_frame(path: Path, index: int) -> U8:
    """Decode one frame; every frame is a key frame, so only its packet is decoded.

    Raises:
        IndexError: the video has fewer frames.
    """
    with av.open(video_url(path)) as container:
        stream = container.streams.video[0]
        for number, packet in enumerate(container.demux(stream)):
            if number == index and packet.size:
                return next(iter(packet.decode())).to_ndarray(format="gray")  # type: ignore[no-any-return]
    raise IndexError(f"{path}: has no frame {index}")


class FrameReader:
    """One frame after another in any order, from a video that stays open; a context manager.

    Frames are coded independently, so one costs a seek, the packets from the last frame in the
    index on, and its own decoding. One thread at a time.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._container = av.open(video_url(path))
        self._stream = self._container.streams.video[0]
        self._stream.codec_context.thread_type = "SLICE"

    def frame(self, index: int) -> U8:
        """One decoded frame, uint8 of shape (height, width).

        Raises:
            IndexError: the video has no such frame.
        """
        step = 1 / (self._stream.average_rate * self._stream.time_base)  # ticks a frame
        if index >= 0:
            self._container.seek(round(index * step), stream=self._stream)
            for packet in self._container.demux(self._stream):
                number = index if packet.pts is None else round(packet.pts / step)
                if number == index and packet.size:
                    return next(iter(packet.decode())).to_ndarray(format="gray")  # type: ignore[no-any-return]
                if number >= index:
                    break
        raise IndexError(f"{self.path}: has no frame {index}")

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def __enter__(self) -> FrameReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def cut_video(path: Path, frames: int, to: Path) -> None:
    """Copy the first frames of a video, as they are encoded, to another file."""
    options = {"fflags": "+bitexact"}
    with (
        av.open(video_url(path)) as source,
        av.open(video_url(to), "w", format="matroska", options=options) as target,
    ):
        stream = source.streams.video[0]
        copied = target.add_stream_from_template(stream)
        packets = (packet for packet in source.demux(stream) if packet.size)
        for packet in islice(packets, frames):
            packet.stream = copied
            target.mux(packet)


def count_frames(path: Path) -> int:
    """Number of frames, counted by packets without decoding."""
    with av.open(video_url(path)) as container:
        return sum(1 for packet in container.demux(container.streams.video[0]) if packet.size)


def frame_rate(path: Path) -> int:
    """Frames a second of a video's time base; the frames have separate times."""
    with av.open(video_url(path)) as container:
        rate: int = round(container.streams.video[0].average_rate)
    return rate
