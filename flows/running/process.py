"""This process: its standard streams, the system's limits, its parent, its garbage collector.

Loads nothing but Python's own modules, and `storage.causes`: the command line reads it where
nothing else can be loaded.
"""

from __future__ import annotations

import ctypes
import errno
import gc
import io
import os
import re
import resource
import select
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TextIO

from sliplab.storage.causes import causes

PATIENCE_S = 1.0
"""Time for which standard error may block before messages are dropped, s."""


class OutputLost(Exception):
    """Standard output did not take a result; the message says why.

    Attributes:
        unread: its reader has ended, as `head` does, which is no error.
    """

    def __init__(self, why: str, unread: bool = False) -> None:
        super().__init__(f"the result cannot be written to standard output: {why}")
        self.unread = unread


class _ByteStream(io.RawIOBase):
    """Bytes to a standard stream.

    Args:
        handle: the stream's file number.
        lost: why nothing can be written, if that is known from the start.
        required: whether an error is raised when the stream takes nothing.
    """

    def __init__(self, handle: int, lost: str = "", *, required: bool) -> None:
        self._handle, self._lost, self._required = handle, lost, required
        self._stalled = self._reported = self._unread = False
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
                self._unread = isinstance(error, BrokenPipeError)
        if self._lost and self._required and not self._reported:
            self._reported = True
            raise OutputLost(self._lost, self._unread)
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
    raw = _ByteStream(number, lost, required=required)
    return io.TextIOWrapper(
        io.BufferedWriter(raw),
        encoding="utf-8" if like is None else like.encoding,
        errors="backslashreplace",  # no file name is worth a failure
        line_buffering=not required or raw.isatty(),
        write_through=not required,
    )


_MEMORY = re.compile(
    r"annot allocate memory|failed to map segment|Unable to allocate|not enough memory|bad_alloc"
    r"|error return without exception set"  # Python's own words where even the error has no room
)
_FILES = re.compile(r"Too many open files")
_PROCESSES = re.compile(r"can't start new thread|Resource temporarily unavailable")
_RAISE = "end other programs or raise the limit"
_LEAST_BYTES = 150 << 20
"""Address space below which numpy cannot be loaded: OpenBLAS then ends the process by itself."""
_PR_SET_PDEATHSIG = 1
_GO_ON = "then run the same command to resume; every committed trial is kept"


def exhausted(error: BaseException | None) -> str | None:
    """Return the exhausted system resource that caused `error`; else None.

    The causes of chained errors are examined, too.
    """
    for each in causes(error, hidden=True):
        number = each.errno if isinstance(each, OSError) else None
        text = str(each)
        if isinstance(each, MemoryError) or number == errno.ENOMEM or _MEMORY.search(text):
            given = _limit(resource.RLIMIT_AS, "-v", 1024)
            return f"there is not enough memory{given}: {_RAISE}, {_GO_ON}"
        if number in {errno.EMFILE, errno.ENFILE} or _FILES.search(text):
            return (
                f"too many files are open{_limit(resource.RLIMIT_NOFILE, '-n')}: raise it, {_GO_ON}"
            )
        if number == errno.EAGAIN or _PROCESSES.search(text):
            given = _limit(resource.RLIMIT_NPROC, "-u")
            return f"no more processes or threads can be started{given}: end some, {_GO_ON}"
    return None


def _limit(kind: int, option: str, unit: int = 1) -> str:
    """Return the limit that this process has, as its shell calls it; empty without one."""
    found = resource.getrlimit(kind)[0]
    return "" if found == resource.RLIM_INFINITY else f" (ulimit {option} is {found // unit})"


def too_few_threads() -> str | None:
    """Return the reason if threads cannot be started; libraries start some when loaded.

    OpenBLAS sends the process SIGINT then, which would pass for Ctrl-C.
    """
    go = threading.Event()
    begun = []
    try:
        for _ in range(os.cpu_count() or 1):
            begun.append(thread := threading.Thread(target=go.wait))
            thread.start()
    except RuntimeError as error:
        begun.pop()
        return exhausted(error)
    finally:
        go.set()
        for thread in begun:
            thread.join()
    return None


def run_in_child() -> str | None:
    """Continue in a child where memory is limited: libraries crash there instead of failing.

    The parent passes signals on to the child, which ends with it. In a program that has loaded
    libraries already nothing is done.

    Returns:
        None in the process that is to continue. The parent ends with its child's exit code, or gets
        the reason here if the child crashed, or if memory is too little to start one.
    """
    if (
        resource.getrlimit(resource.RLIMIT_AS)[0] == resource.RLIM_INFINITY
        or "numpy" in sys.modules
    ):
        return None
    if resource.getrlimit(resource.RLIMIT_AS)[0] < _LEAST_BYTES:
        return exhausted(MemoryError())
    passed = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    before = signal.pthread_sigmask(signal.SIG_BLOCK, passed | {signal.SIGCHLD})
    parent = os.getpid()
    child = os.fork()
    if child == 0:
        # OpenBLAS waits for ever for the memory of a thread that it does not get
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        watched = die_with(parent)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if not watched:
            os.kill(os.getpid(), signal.SIGTERM)
        return None
    while True:  # as long as the child runs
        came = signal.sigwaitinfo(passed | {signal.SIGCHLD})
        if came.si_signo != signal.SIGCHLD:
            if came.si_pid:  # Ctrl-C in a terminal, which has no sender, reached the child, too
                os.kill(child, came.si_signo)
            continue
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
    code = os.waitstatus_to_exitcode(status)
    if code >= 0:
        sys.exit(code)
    given = _limit(resource.RLIMIT_AS, "-v", 1024)
    name = signal.strsignal(-code)
    return (
        f"a library crashed ({name}), as it does without enough memory{given}: {_RAISE}, {_GO_ON}"
    )


def die_with(parent: int) -> bool:
    """Ask the kernel to send this process SIGTERM when its parent ends, however it ends.

    Returns:
        False if the parent has ended already.
    """
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    return os.getppid() == parent


THRESHOLDS = (50_000, 20, 100)
"""Thresholds of `gc.set_threshold`."""


def collect_garbage_seldom() -> None:
    """Reduce the frequency of garbage collection from here on.

    Nearly all objects are modules. With Python's own thresholds the collector traverses them
    again and again while more is imported, which takes a fifth of the start-up time.
    """
    gc.set_threshold(*THRESHOLDS)
