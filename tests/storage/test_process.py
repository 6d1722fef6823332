"""Children of a process: they end with it, and leave the terminal's signals to it."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from contextlib import suppress

import pytest

from sliplab.storage.process import out_of_reach, start_tethered

PARENT = """
import sys, time
from sliplab.storage.process import start_tethered

child = start_tethered(["sh", "-c", "sleep 600 & echo $! $$; wait"], stdout=-1)
print(child.stdout.readline().decode(), flush=True)
time.sleep(600)
"""


def ended(handle: int, within_s: float) -> bool:
    return bool(select.select([handle], [], [], within_s)[0])


def test_tethered_program_and_its_child_end_with_a_killed_parent() -> None:
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE) as parent:
        handles = [os.pidfd_open(int(pid)) for pid in parent.stdout.readline().split()]
        try:
            assert not any(ended(handle, 0) for handle in handles)
            parent.kill()
            parent.wait(30)
            assert all(ended(handle, 30) for handle in handles)
        finally:
            for handle in handles:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(handle, signal.SIGKILL)
                os.close(handle)


def test_tethered_program_runs_to_its_end_and_has_its_own_session() -> None:
    process = start_tethered(["sh", "-c", "cat; ps -o sid= -p $$"], stdin=-1, stdout=-1)
    said, _ = process.communicate(b"hello ", timeout=30)
    assert said.split() == [b"hello", str(process.pid).encode()]
    assert process.returncode == 0


def test_missing_tethered_program_leaves_nothing_open() -> None:
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(FileNotFoundError):
        start_tethered(["/no/such/program"])
    assert len(os.listdir("/proc/self/fd")) == before


def test_children_begin_with_signals_of_the_terminal_blocked() -> None:
    command = [sys.executable, "-c", "import signal; print(*signal.pthread_sigmask(0, []))"]
    with out_of_reach():
        child = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    said, _ = child.communicate(timeout=30)
    assert {signal.SIGINT, signal.SIGHUP} <= {int(number) for number in said.split()}
    assert not {signal.SIGINT, signal.SIGHUP} & signal.pthread_sigmask(signal.SIG_BLOCK, [])


SEEN_BLOCKED = """
import signal
from sliplab.storage.process import out_of_reach
from sliplab.storage.spawn_context import WORKERS
with out_of_reach():
    first = WORKERS.Process(target=len, args=((),))
    first.start()
    print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))
first.join()
"""


def test_the_first_child_is_out_of_reach_too() -> None:
    """The tracker of multiprocessing, which starts with it, unblocks signals."""
    done = subprocess.run(
        [sys.executable, "-c", SEEN_BLOCKED], capture_output=True, text=True, timeout=60
    )
    assert done.stdout.split() == ["True"], done.stderr
