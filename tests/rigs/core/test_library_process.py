"""A library in a process of its own: every call ends, and an answer belongs to its call."""

from __future__ import annotations

import gc
import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import pytest

from sliplab.rigs.core.library_process import LibraryError, LibraryProcess
from sliplab.storage.spawn_context import MainModuleError

HERE = "tests.rigs.core.test_library_process"


def serve(fd: int, word: str) -> None:
    """The child: it says things back, late or never."""
    pipe = Connection(fd)
    pipe.send((True, word))
    with suppress(EOFError):
        while True:
            name, arguments, _ = pipe.recv()
            if name == "die":
                os.write(2, b"terminate called\n  what(): no \xff packet\n")
                os._exit(6)
            if name in {"half", "drip"}:
                os.write(fd, (100_000).to_bytes(4, "big"))
                while name == "drip":
                    os.write(fd, b"x")
                    threading.Event().wait(0.05)
                threading.Event().wait(60.0)
            if name == "late":
                threading.Event().wait(arguments[0])
            pipe.send((name != "fail", name))


@pytest.fixture
def process() -> LibraryProcess:
    return LibraryProcess("echo", f"{HERE}:serve", ("hello",), 60.0)


def test_calls_and_refusals(process: LibraryProcess) -> None:
    assert process.begun == "hello"
    assert process.call("any", within_s=20.0) == "any"
    with pytest.raises(LibraryError, match="fail: fail"):
        process.call("fail", within_s=20.0)
    assert process.call("any", within_s=20.0) == "any"
    process.end()
    with pytest.raises(LibraryError, match="the echo has exited"):
        process.call("any", within_s=20.0)
    process.end()


def test_child_survives_signals_that_all_processes_get(process: LibraryProcess) -> None:
    """The arm is stopped through it: the parent ends it afterwards."""
    assert os.getsid(process.pid) == process.pid  # those of a terminal do not reach it
    os.kill(process.pid, signal.SIGTERM)
    assert process.call("any", within_s=20.0) == "any"
    process.end()


def test_a_death_says_what_the_library_said_last(process: LibraryProcess) -> None:
    with pytest.raises(LibraryError, match=r"died \(its last output:   what\(\): no . packet\)"):
        process.call("die", within_s=20.0)
    process.close()


def test_a_call_that_is_too_late_ends_the_child(process: LibraryProcess) -> None:
    began = time.monotonic()
    with pytest.raises(LibraryError, match=r"late: no answer within 0\.2 s"):
        process.call("late", 60.0, within_s=0.2)
    with pytest.raises(LibraryError, match="has exited"):
        process.call("any", within_s=20.0)
    assert time.monotonic() - began < 30.0
    process.close()


@pytest.mark.quick(1)
@pytest.mark.parametrize("ignore_suspend", [False, True])
@pytest.mark.parametrize("name", ["half", "drip"])
def test_answer_that_does_not_end_has_one_deadline(name: str, ignore_suspend: bool) -> None:
    process = LibraryProcess(
        "echo", f"{HERE}:serve", ("hello",), 60.0, ignore_suspend=ignore_suspend
    )
    began = time.monotonic()
    with pytest.raises(LibraryError, match=rf"{name}: no whole answer within 0\.4 s"):
        process.call(name, within_s=0.4)
    assert time.monotonic() - began < 10.0
    with pytest.raises(LibraryError, match="has exited"):
        process.call("any", within_s=20.0)
    process.close()


@pytest.mark.filterwarnings("ignore::ResourceWarning")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_unreferenced_process_ends() -> None:
    process = LibraryProcess("echo", f"{HERE}:serve", ("hello",), 60.0)
    child = process._child
    del process
    gc.collect()
    child.wait(20.0)


def test_a_computer_that_stood_still_is_no_fault_of_the_child(monkeypatch: Any) -> None:
    process = LibraryProcess("echo", f"{HERE}:serve", ("hello",), 60.0, ignore_suspend=True)
    pipe, now_ns = process._calls.pipe, time.monotonic_ns
    late_ns = [0]

    class StoodStill:
        """A pipe during whose first wait a minute passes."""

        closed = False
        send, recv_bytes = staticmethod(pipe.send), staticmethod(pipe.recv_bytes)

        def poll(self, within_s: float) -> bool:
            if not late_ns[0]:
                late_ns[0] = 60_000_000_000
                return False
            return pipe.poll(within_s)

    with monkeypatch.context() as patch:
        patch.setattr(time, "monotonic_ns", lambda: now_ns() + late_ns[0])
        patch.setattr(process._calls, "pipe", StoodStill())
        assert process.call("any", within_s=20.0) == "any"
        assert late_ns[0]
    with pytest.raises(LibraryError, match=r"late: no answer within 0\.3 s"):
        process.call("late", 60.0, within_s=0.3)
    process.close()


def test_after_ctrl_c_an_answer_is_still_its_own_calls(process: Any, monkeypatch: Any) -> None:
    pipe = process._calls.pipe

    class Interrupted:
        """A pipe during whose first wait a person presses Ctrl-C."""

        closed = False
        send = staticmethod(pipe.send)

        def poll(self, within_s: float) -> bool:
            raise KeyboardInterrupt

    monkeypatch.setattr(process._calls, "pipe", Interrupted())
    with pytest.raises(KeyboardInterrupt):
        process.call("late", 0.1, within_s=20.0)
    monkeypatch.setattr(process._calls, "pipe", pipe)
    assert process.call("other", within_s=20.0) == "other"
    process.close()


def test_function_of_the_main_script_is_refused() -> None:
    with pytest.raises(MainModuleError, match="serve: is defined in the script that runs"):
        LibraryProcess("echo", "__main__:serve", (), 60.0)
