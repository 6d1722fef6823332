"""Real-time priority for a process that a reflex waits for, so that other programs do not delay it.

Linux allows it with the capability CAP_SYS_NICE, or by the limits `rtprio` and `memlock` of
`/etc/security/limits.conf`.
"""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PRIORITY = 10
"""Of `SCHED_RR`, 1 to 99: before all ordinary programs, after what the system itself needs."""
_CURRENT, _FUTURE, _ON_FAULT = 1, 2, 4
"""Flags of `mlockall(2)`: pages stay in memory once they were used."""


@contextmanager
def real_time() -> Iterator[str]:
    """Put all threads of this process first; yield what the system does not allow, or nothing.

    Children have the ordinary priority. What exists now is not searched for garbage meanwhile.
    """
    if sys.platform != "linux":
        yield "real-time priority, which needs Linux"
        return
    refused = []
    if not _schedule(os.SCHED_RR | os.SCHED_RESET_ON_FORK, PRIORITY):
        refused.append(f"real-time priority {PRIORITY} (rtprio)")
    libc = ctypes.CDLL(None)
    if libc.mlockall(_CURRENT | _FUTURE | _ON_FAULT):
        refused.append("to keep this program in memory (memlock)")
    gc.collect()
    gc.freeze()
    try:
        yield " or ".join(refused)
    finally:
        gc.unfreeze()
        libc.munlockall()
        _schedule(os.SCHED_OTHER | os.SCHED_RESET_ON_FORK, 0)


def _schedule(policy: int, priority: int) -> bool:
    """Set the policy of all threads; return False where the system does not allow it."""
    try:
        for thread in os.listdir("/proc/self/task"):
            with suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread), policy, os.sched_param(priority))
    except OSError:
        return False
    return True
