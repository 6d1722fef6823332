"""Real-time priority for a process that a reflex waits for, so that other programs do not delay it.

Linux allows it with the capability CAP_SYS_NICE, or by the limits `rtprio` and `memlock` of
`/etc/security/limits.conf`. A process that never waits leaves a core's other programs the 5 % of
`/proc/sys/kernel/sched_rt_runtime_us`; a detector's is killed where it does not answer in time.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PRIORITY = 10
"""Of `SCHED_RR`, 1 to 99: before all ordinary programs, after what the system itself needs."""
BELOW = PRIORITY - 1
"""That of a detector's process: one that never waits does not delay the stop of the arm."""
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4
"""Flags of `mlockall(2)`: pages stay in memory once they were used."""


@contextmanager
def real_time(priority: int = PRIORITY) -> Iterator[str]:
    """Put all threads of this process first; yield what the system does not allow, or nothing.

    Threads that Python starts meanwhile, too, such as an arm's for a path; those that a library
    starts then, and children, have the ordinary priority. What exists now is not searched for
    garbage meanwhile.
    """
    if sys.platform != "linux":
        yield "real-time priority, which needs Linux"
        return
    refused = []
    first = os.SCHED_RR | os.SCHED_RESET_ON_FORK

    def begun(*_: object) -> None:
        """Run once in each new thread, before its work."""
        sys.setprofile(None)
        _schedule(["0"], first, priority)

    before = threading.getprofile()
    if _schedule(_threads(), first, priority):
        threading.setprofile(begun)
    else:
        refused.append(f"real-time priority {priority} (rtprio)")
    libc = ctypes.CDLL(None)
    # within a limit, memory that is allocated later would be refused once it is reached
    endless = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0] == resource.RLIM_INFINITY
    if libc.mlockall(_CURRENT | _ON_FAULT | (_FUTURE if endless else 0)):
        refused.append("to keep this program in memory (memlock)")
    gc.collect()
    gc.freeze()
    try:
        yield " or ".join(refused)
    finally:
        gc.unfreeze()
        libc.munlockall()
        threading.setprofile(before)
        _schedule(_threads(), os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)


def _threads() -> list[str]:
    return os.listdir("/proc/self/task")


def _schedule(threads: list[str], policy: int, priority: int) -> bool:
    """Set the policy of threads, "0" for this one; return False where the system does not allow it.

    Some sandboxes do nothing and report no error.
    """
    try:
        for thread in map(int, threads):
            with suppress(ProcessLookupError):
                os.sched_setscheduler(thread, policy, os.sched_param(priority))
                if (os.sched_getscheduler(thread) ^ policy) & ~os.SCHED_RESET_ON_FORK:
                    return False
    except OSError:
        return False
    return True
