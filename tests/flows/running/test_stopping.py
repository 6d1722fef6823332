"""A stop request is never lost, wherever the signal finds the program."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from sliplab.flows.running import console, stopping
from tests.conftest import ROOT


@pytest.fixture
def terminal() -> Iterator[None]:
    """A terminal whose end is noticed: the tests may run under nohup, which ignores it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.usefixtures("terminal")
def test_a_signal_interrupts_and_is_remembered() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        with stopping.signals():
            assert not stopping.requested()
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)  # in this thread, and at once
            assert stopping.requested()
            with pytest.raises(KeyboardInterrupt):
                stopping.check()


def test_a_signal_that_python_drops_is_remembered(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a destructor the exception is dropped, and nothing is printed of it; the flag stays."""
    printed: list[object] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda dropped: printed.append(dropped.exc_type))

    class Unlucky:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)

    with stopping.signals():
        unlucky = Unlucky()
        del unlucky
        assert stopping.requested()
        with pytest.raises(KeyboardInterrupt), console.bar("work", 1) as bar:
            bar.advance()
        assert printed == []
        faulty = Faulty()
        del faulty
    assert printed == [ValueError]  # of any other fault it is


class Faulty:
    def __del__(self) -> None:
        raise ValueError


def test_a_signal_that_a_compiled_function_meets_is_an_interruption() -> None:
    """Numba returns a SystemError in place of what its caller's signal handler raised."""

    def compiled() -> None:
        with suppress(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        raise SystemError("returned a result with an exception set")

    with pytest.raises(KeyboardInterrupt), stopping.signals():
        compiled()
    with pytest.raises(SystemError), stopping.signals():
        raise SystemError("a fault of its own")


def test_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with stopping.signals():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


def test_a_program_that_outlives_its_terminal_is_not_stopped_by_it() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with stopping.signals():
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stopping.requested()
    finally:
        signal.signal(signal.SIGHUP, before)


ORPHANS = """
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from sliplab.flows.running import stopping

if __name__ == "__main__":
    with ProcessPoolExecutor(
        2, mp_context=get_context("spawn"), initializer=stopping.leave_to_parent
    ) as pool:
        for each in [pool.submit(os.getpid) for _ in range(64)]:
            each.result()
        print(*(worker.pid for worker in pool._processes.values()), flush=True)
        input()
"""


def test_workers_end_with_a_killed_parent(tmp_path: Path) -> None:
    """Each of them waits at a pipe whose other end its neighbour holds: no end of file comes."""
    script = tmp_path / "pool.py"
    script.write_text(ORPHANS)
    parent = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert parent.stdin is not None
    assert parent.stdout is not None
    with parent.stdin, parent.stdout:
        workers = [os.pidfd_open(int(pid)) for pid in parent.stdout.readline().split()]
        try:
            assert len(workers) == 2
            assert select.select(workers, [], [], 0)[0] == []
            parent.kill()
            parent.wait(30)
            for worker in workers:
                assert select.select([worker], [], [], 30)[0] == [worker]
        finally:
            for worker in workers:
                with suppress(ProcessLookupError):
                    signal.pidfd_send_signal(worker, signal.SIGKILL)
                os.close(worker)


AT_AN_EDGE = """
import os, signal, sys
import sliplab.flows.__main__ as program
from sliplab.flows.__main__ import main

place, number = sys.argv.pop(1), int(sys.argv.pop(1))

class Finder:
    def find_spec(self, name, *_):
        if name == place:
            os.kill(os.getpid(), number)

run = program._run

def ending():
    code = run()
    os.kill(os.getpid(), number)
    return code

sys.meta_path.insert(0, Finder())
if place == "end":
    program._run = ending
main()
"""


@pytest.mark.quick(2)
@pytest.mark.usefixtures("terminal")
@pytest.mark.parametrize("number", stopping.SIGNALS)
@pytest.mark.parametrize(
    "place",
    ["sliplab.flows.running.console", "sliplab.storage.process", "sliplab.flows.cli.app", "end"],
)
def test_signal_before_or_after_the_work_is_said_in_one_line(
    place: str, number: signal.Signals, tmp_path: Path
) -> None:
    script = tmp_path / "program.py"
    script.write_text(AT_AN_EDGE)
    done = subprocess.run(
        [sys.executable, str(script), place, str(int(number)), "--version"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    assert done.returncode == 130, done.stderr
    assert done.stderr.startswith("interrupted")
    assert len(done.stderr.splitlines()) == 1


AT_THE_END = """
import multiprocessing, os, signal, sys, types
from sliplab.flows.__main__ import main

lock = multiprocessing.get_context("spawn").Lock()
server = types.ModuleType("orchestration")
server.close = lambda: os.kill(os.getpid(), signal.SIGINT)
sys.modules["sliplab.flows.running.orchestration"] = server
sys.argv[1:] = ["--version"]
main()
"""


def test_signal_while_the_program_ends_leaves_no_semaphore() -> None:
    done = subprocess.run(
        [sys.executable, "-c", AT_THE_END], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("sliplab ")
