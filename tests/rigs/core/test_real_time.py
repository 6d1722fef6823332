"""Real-time priority: of all threads, not of children, and given back; or said to be refused."""

from __future__ import annotations

import errno
import multiprocessing
import os
import resource
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest

from sliplab.flows.detecting.detector_process import _answer
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


needs_priority = pytest.mark.skipif(
    not allowed(), reason="the system does not allow real-time priority"
)


@needs_priority
def test_all_threads_come_first_and_children_do_not() -> None:
    done = threading.Event()
    other = threading.Thread(target=done.wait)
    other.start()
    code = "import os; print(os.sched_getscheduler(0))"
    with real_time.real_time() as refused:
        assert "rtprio" not in refused
        assert policies() == {os.SCHED_RR}
        later: list[int] = []
        thread = threading.Thread(target=lambda: later.append(os.sched_getscheduler(0) & ~RESET))
        thread.start()
        thread.join()
        child = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert later == [os.SCHED_RR]
    assert threading.getprofile() is None
    assert int(child.stdout) == os.SCHED_OTHER
    assert policies() == {os.SCHED_OTHER}
    done.set()
    other.join()


@needs_priority
def test_a_detectors_process_comes_after_the_program_that_stops_the_arm() -> None:
    """And only once it has worked: kernels are compiled in the first call."""
    ours, theirs = multiprocessing.Pipe()

    def priority(what: str, arguments: tuple[object, ...]) -> int:
        return os.sched_getparam(0).sched_priority

    def serve() -> None:
        found = []
        for what in ("begin", "push", "push"):
            ours.send((what, (), 1.0))
            found.append(ours.recv())
        ours.close()
        answers.extend(found)

    answers: list[tuple[bool, int]] = []
    caller = threading.Thread(target=serve)
    caller.start()
    _answer(theirs, priority, True)
    caller.join()
    assert answers == [(True, 0), (True, 0), (True, real_time.BELOW)]
    assert real_time.BELOW < real_time.PRIORITY


def test_what_the_system_refuses_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments: object) -> None:
        raise PermissionError(errno.EPERM, "Operation not permitted")

    for kind in (refuse, lambda *arguments: None):  # some sandboxes say nothing
        monkeypatch.setattr(os, "sched_setscheduler", kind)
        with real_time.real_time() as refused:
            assert "real-time priority 10 (rtprio)" in refused
            assert threading.getprofile() is None


@pytest.mark.parametrize(("limit", "flags"), [(resource.RLIM_INFINITY, 7), (1 << 33, 5)])
def test_a_limit_of_locked_memory_does_not_refuse_later_memory(
    monkeypatch: pytest.MonkeyPatch, limit: int, flags: int
) -> None:
    """All of a later allocation counts for the limit: it would fail, with the arm in motion."""
    asked: list[int] = []
    library = SimpleNamespace(mlockall=asked.append, munlockall=lambda: 0)
    monkeypatch.setattr("ctypes.CDLL", lambda name: library)
    monkeypatch.setattr(resource, "getrlimit", lambda kind: (limit, limit))
    with real_time.real_time() as refused:
        assert "memlock" not in refused
    assert asked == [flags]
