"""Limits of the system that end a program: memory, open files, processes and threads.

Loads nothing but Python's own modules: the command line reads it where nothing else can be loaded.
"""

from __future__ import annotations

import ctypes
import errno
import os
import re
import resource
import signal
import sys
import threading

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
_GO_ON = "then run the same command to go on; every committed trial is kept"


def exhausted(error: BaseException | None) -> str | None:
    """Return what the system has no more of, if that is behind `error`; else None.

    Errors that were raised in place of the system's own are looked through.
    """
    while error is not None:
        number = error.errno if isinstance(error, OSError) else None
        text = str(error)
        if isinstance(error, MemoryError) or number == errno.ENOMEM or _MEMORY.search(text):
            given = _limit(resource.RLIMIT_AS, "-v", 1024)
            return f"there is not enough memory{given}: {_RAISE}, {_GO_ON}"
        if number in {errno.EMFILE, errno.ENFILE} or _FILES.search(text):
            return (
                f"too many files are open{_limit(resource.RLIMIT_NOFILE, '-n')}: raise it, {_GO_ON}"
            )
        if number == errno.EAGAIN or _PROCESSES.search(text):
            given = _limit(resource.RLIMIT_NPROC, "-u")
            return f"no more processes or threads can be started{given}: end some, {_GO_ON}"
        error = error.__cause__ or error.__context__
    return None


def _limit(kind: int, option: str, unit: int = 1) -> str:
    """Return the limit that this process has, as its shell calls it; empty without one."""
    found = resource.getrlimit(kind)[0]
    return "" if found == resource.RLIM_INFINITY else f" (ulimit {option} is {found // unit})"


def too_few_threads() -> str | None:
    """Say that threads cannot be started, where they cannot; libraries start some when loaded.

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
    """Go on in a child process where memory is limited: there libraries crash instead of failing.

    The parent passes signals on to the child, which ends with it. In a program that has loaded
    libraries already nothing is done.

    Returns:
        None in the process that is to go on. The parent ends with its child's exit code, or gets
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
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        if os.getppid() != parent:
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
