"""Limits of the system that end a program: memory, open files, processes and threads.

Loads nothing but Python's own modules: the command line reads it where nothing else can be loaded.
"""

from __future__ import annotations

import errno
import re
import resource

_MEMORY = re.compile(
    r"annot allocate memory|failed to map segment|Unable to allocate|not enough memory|bad_alloc"
)
_FILES = re.compile(r"Too many open files")
_PROCESSES = re.compile(r"can't start new thread|Resource temporarily unavailable")
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
            return f"there is not enough memory{given}: end other programs, {_GO_ON}"
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
