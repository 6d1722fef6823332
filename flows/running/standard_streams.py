"""Standard input, output and error, of which any may be closed, full, or without a reader.

Messages must never stop a program that moves an arm: what standard error does not take within
`PATIENCE_S` is dropped, and so is everything once its reader is gone. Results must arrive: if
standard output does not take them, the program says so and fails (`OutputLost`).

A stream that was closed before the program began is opened on /dev/null, since the next file that
is opened would get its number, and whatever a library prints would end up in a trial.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

PATIENCE_S = 1.0
"""How long standard error may take no more before messages are dropped."""


class OutputLost(Exception):
    """Standard output did not take a result; the message says why."""


class _Stream(io.RawIOBase):
    """Bytes to a standard stream.

    Args:
        handle: the stream's file number.
        lost: why nothing can be written, if that is known from the start.
        required: whether an error is raised when the stream takes nothing.
    """

    def __init__(self, handle: int, lost: str = "", *, required: bool) -> None:
        self._handle, self._lost, self._required = handle, lost, required
        self._stalled = self._told = False
        self._poll = select.poll()
        self._poll.register(handle, select.POLLOUT)

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self._handle

    def isatty(self) -> bool:
        return not self._lost and os.isatty(self._handle)

    def write(self, data: object) -> int:
        """Write some of `data`, or drop it.

        Raises:
            OutputLost: once, if the data are required.
        """
        assert isinstance(data, bytes | memoryview)
        if not self._lost and self._ready():
            try:
                # so much a pipe that is ready takes without waiting
                return os.write(self._handle, data[: select.PIPE_BUF])
            except BlockingIOError:
                return 0
            except OSError as error:
                self._lost = error.strerror or type(error).__name__
        if self._lost and self._required and not self._told:
            self._told = True
            raise OutputLost(f"the result cannot be written to standard output: {self._lost}")
        return len(data)

    def _ready(self) -> bool:
        """Wait until the stream takes something: a result's reader may be slow."""
        if self._required:
            while not self._poll.poll(1000 * PATIENCE_S):  # Ctrl-C ends it
                pass
            return True
        self._stalled = not self._poll.poll(0 if self._stalled else 1000 * PATIENCE_S)
        return not self._stalled


@contextmanager
def guarded() -> Iterator[None]:
    """Guard the standard streams while the block runs; those that a test put there are left alone.

    Raises:
        OutputLost: when the block ends, standard output does not take what is left.
    """
    closed = {number for number in (0, 1, 2) if not _is_open(number)}
    for _ in closed:
        os.open(os.devnull, os.O_RDWR)  # the lowest number that is free
    before = sys.stdin, sys.stdout, sys.stderr
    if sys.stdin is None:
        sys.stdin = os.fdopen(0, closefd=False)
    if sys.stdout is sys.__stdout__:
        sys.stdout = _text(1, "it is closed" if 1 in closed else "", sys.stdout, required=True)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _text(2, "it is closed" if 2 in closed else "", sys.stderr, required=False)
    try:
        yield
        sys.stdout.flush()
    finally:
        with suppress(OutputLost):
            sys.stdout.flush()
        sys.stdin, sys.stdout, sys.stderr = before


def _is_open(number: int) -> bool:
    try:
        os.fstat(number)
    except OSError:
        return False
    return True


def _text(number: int, lost: str, like: TextIO | None, *, required: bool) -> TextIO:
    raw = _Stream(number, lost, required=required)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding="utf-8" if like is None else like.encoding,
        errors="backslashreplace",  # no file name is worth a failure
        line_buffering=not required or raw.isatty(),
        write_through=not required,
    )
