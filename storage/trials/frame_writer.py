"""Frames of one camera while a trial is written: their rows, and a video or tracks.

Raw frames of a rig that cannot encode as fast as its camera delivers wait in a spool file. The
caller never waits for the disk while the spool's queue has room. What was written is sent on to the
disk at once: an operating system that gathers gigabytes first stops every writer when it has
enough of them, the one with the events too.
"""

from __future__ import annotations

import os
import threading
import zlib
from collections import deque
from contextlib import suppress
from pathlib import Path

import numpy as np

from sliplab.storage.streams import FRAMES, U8, FrameChunk
from sliplab.storage.trials.hdf5_writer import StreamFile
from sliplab.storage.trials.video import VideoWriter

QUEUE_BYTES = 1 << 29
"""The most that waits in memory, bytes: five seconds of 1000 x 1000 px at 100/s."""
WAIT_S = 60.0
"""The longest that a full queue, and the end of the file, are waited for, s."""
_AHEAD_BYTES = 1 << 24


class FrameWriter:
    """Writes the frames of one camera; whether there is a video shows with the first frame.

    A camera may return tracks instead, which go to the HDF5 file.

    Args:
        streams: the HDF5 file of the frames' rows; it is closed by its owner, before `seal`.
        video: path of the video.
        spool: path of a file in which raw frames wait until `seal`; None to encode them at once.
        size_px: width and height of the frames; that of the first ones if left out.
        guarded: write them at once, for a program that may be killed, and compute a checksum.
    """

    def __init__(
        self,
        streams: StreamFile,
        video: Path,
        spool: Path | None,
        rate_hz: int,
        size_px: tuple[int, int] | None = None,
        guarded: bool = False,
    ) -> None:
        self._streams, self._path, self._rate_hz = streams, video, rate_hz
        self._guarded, self._images, self._crc = guarded, 0, 0
        self._encoding: deque[FrameChunk] = deque()
        self._size_px, self._raw = size_px, spool
        self._spool: Spool | None = None
        self._video: VideoWriter | None = None

    def add(self, chunk: FrameChunk) -> None:
        """Append frames, or the tracks in place of them, and their times."""
        if not len(chunk):
            return
        if not self._guarded or chunk.markers_px is not None:
            self._streams.add(FRAMES.name, chunk)
        if chunk.markers_px is not None:
            self._streams.add_tracks(chunk)
            return
        if self._size_px is None:
            self._size_px = chunk.images.shape[2], chunk.images.shape[1]
        if self._raw is not None:
            self._spool = self._spool or Spool(self._raw)
            self._spool.write(chunk.images)
        else:
            if self._video is None:
                size, guarded = self._size_px, self._guarded
                self._video = VideoWriter(self._path, *size, self._rate_hz, guarded=guarded)
            self._video.write(chunk.images)
            if self._guarded:
                self._encoding.append(chunk)
                self._add_rows(self._video.muxed - 1)  # the last one waits for the next

    def _add_rows(self, written: int) -> None:
        """Add the rows of frames that are in the video."""
        while self._encoding and self._images + len(self._encoding[0]) <= written:
            chunk = self._encoding.popleft()
            self._streams.add(FRAMES.name, chunk)
            self._images += len(chunk)
            self._crc = zlib.crc32(np.ascontiguousarray(chunk.images).data, self._crc)

    def settle(self) -> None:
        """Write what is being encoded, with its rows, before the HDF5 file is closed."""
        if self._guarded and self._video is not None:
            self._video.close()
            self._add_rows(self._video.frames)

    def mark(self) -> list[int]:
        """Return how many images were written, and their CRC-32."""
        return [self._images, self._crc]

    def seal(self) -> None:
        """Finish the video."""
        if self._spool is not None:
            self._spool.close()
            self._encode(self._spool.path)
        if self._video is not None:
            self._video.close()

    def _encode(self, spool: Path) -> None:
        if self._size_px is not None:
            width, height = self._size_px
            empty = spool.stat().st_size == 0  # which cannot be mapped
            levels = np.empty(0, np.uint8) if empty else np.memmap(spool, np.uint8, "r")
            frames = levels.reshape(-1, height, width)
            self._video = VideoWriter(self._path, width, height, self._rate_hz)
            for start in range(0, len(frames), 64):
                self._video.write(frames[start : start + 64])
            self._video.close()
            del frames, levels
        spool.unlink()

    def abandon(self) -> None:
        """Close open files, as far as the disk permits."""
        if self._spool is not None:
            with suppress(OSError):
                self._spool.close()
        if self._video is not None:
            self._video.close()


class Spool:
    """A file of grey frames, one after the other; bounded in memory."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = path.open("wb", buffering=0)
        self._waiting: deque[U8] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._error: OSError | None = None
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="spool", daemon=True)
        self._thread.start()

    def write(self, images: U8) -> None:
        """Append frames, which must not change afterwards; waits only where the queue is full.

        Raises:
            OSError: the disk refused these or earlier ones, or made no progress for `WAIT_S`.
        """
        if not images.size:
            return
        images = np.ascontiguousarray(images)
        with self._changed:
            done = self._changed.wait_for(
                lambda: self._error or self._bytes < QUEUE_BYTES, timeout=WAIT_S
            )
            self._check()
            if not done:
                raise OSError(f"{self.path}: the disk has hung for {WAIT_S:g} s")
            self._waiting.append(images)
            self._bytes += images.nbytes
            self._changed.notify_all()

    def close(self) -> None:
        """Write what waits, and close the file; safe to call more than once.

        Raises:
            OSError: not all of it could be written.
        """
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(WAIT_S)
        if self._thread.is_alive():
            raise OSError(f"{self.path}: the disk has hung for {WAIT_S:g} s")
        self._file.close()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        written = sent_on = 0
        try:
            while (images := self._next()) is not None:
                left = images.reshape(-1).data
                while left:
                    left = left[self._file.write(left) or 0 :]
                written += images.nbytes
                if written - sent_on >= _AHEAD_BYTES:
                    self._send_on(written)
                    sent_on = written
                with self._changed:
                    self._bytes -= images.nbytes
                    self._changed.notify_all()
        except OSError as error:
            with self._changed:
                self._error = error
                self._waiting.clear()
                self._changed.notify_all()

    def _next(self) -> U8 | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            return self._waiting.popleft() if self._waiting else None

    def _send_on(self, end: int) -> None:
        """Begin to write to the disk, and drop what is there from memory, where the system can."""
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file.fileno(), 0, end, os.POSIX_FADV_DONTNEED)
