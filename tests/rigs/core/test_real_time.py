"""Real-time priority: of all threads, not of children, and given back; or said to be refused."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading

import pytest

from sliplab.rigs.core import real_time

RESET = os.SCHED_RESET_ON_FORK


def policies() -> set[int]:
    """Scheduling policies of this process's threads."""
    threads = os.listdir("/proc/self/task")
    return {os.sched_getscheduler(int(thread)) & ~RESET for thread in threads}


def allowed() -> bool:
    """Whether this system lets tests have the priority."""
    with real_time.real_time() as refused:
        return "rtprio" not in refused


@pytest.mark.skipif(not allowed(), reason="the system does not allow real-time priority")
def test_all_threads_come_first_and_children_do_not() -> None:
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    code = "import os; print(os.sched_getscheduler(0))"
    with real_time.real_time() as refused:
        assert "rtprio" not in refused
        assert policies() == {os.SCHED_RR}
        child = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert int(child.stdout) == os.SCHED_OTHER
    assert policies() == {os.SCHED_OTHER}
    done.set()
    other.join()


def test_what_the_system_refuses_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with real_time.real_time() as refused:
        assert "real-time priority 10 (rtprio)" in refused
