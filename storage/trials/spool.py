"""Raw frames on their way to the disk: a file, and a thread that writes it.

The caller never waits for the disk while the queue has room. What was written is sent on to the
disk at once: an operating system that gathers gigabytes first stops every writer when it has
enough of them, the one with the events too.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from pathlib import Path

import numpy as np

from sliplab.storage.streams import U8

QUEUE_BYTES = 1 << 29
"""The most that waits in memory, bytes: five seconds of 1000 x 1000 px at 100/s."""
WAIT_S = 60.0
"""The longest that a full queue, and the end of the file, are waited for, s."""
_AHEAD_BYTES = 1 << 24


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
            OSError: the disk refused these or earlier ones, or has stood still for `WAIT_S`.
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
                raise OSError(f"{self.path}: the disk has stood still for {WAIT_S:g} s")
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
            raise OSError(f"{self.path}: the disk has stood still for {WAIT_S:g} s")
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
        """Begin to write to the disk, and forget what is there already, where one can ask so."""
        if hasattr(os, "posix_fadvise"):
            os.posix_fadvise(self._file.fileno(), 0, end, os.POSIX_FADV_DONTNEED)
