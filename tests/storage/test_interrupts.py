"""Signals in functions that finish their files first."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from sliplab.flows.running import stopping
from sliplab.storage import interrupts
from sliplab.storage.interrupts import interruptible, uninterrupted


@pytest.fixture(autouse=True)
def handlers() -> Iterator[None]:
    with stopping.signals():
        yield
    interrupts._deferred.clear()


def send(times: int = 1, number: int = signal.SIGINT) -> None:
    for _ in range(times):
        os.kill(os.getpid(), number)


@uninterrupted
def write(done: list[str], times: int, number: int = signal.SIGINT) -> str:
    done.append("first file")
    send(times, number)
    assert times == 0 or stopping.requested()  # the arm's motion stops at once
    done.append("second file")
    return "result"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("times", [1, 2, 10])
def test_signal_in_uninterrupted_function_raises_at_its_end(
    number: int, times: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = signal.signal(signal.SIGHUP, stopping._handle)  # under nohup it is ignored
    done: list[str] = []
    try:
        with pytest.raises(KeyboardInterrupt):
            write(done, times, number)
    finally:
        signal.signal(signal.SIGHUP, before)
    assert done == ["first file", "second file"]
    assert write(done, 0) == "result"  # nothing is left of it


def test_signal_in_nested_uninterrupted_function_raises_at_the_outer_end() -> None:
    done: list[str] = []

    @uninterrupted
    def outer() -> None:
        write(done, 1)
        done.append("third file")

    with pytest.raises(KeyboardInterrupt):
        outer()
    assert done == ["first file", "second file", "third file"]


def test_signal_in_interruptible_function_raises_at_once() -> None:
    done: list[str] = []

    @interruptible
    def move() -> None:
        send()
        done.append("moved")

    @uninterrupted
    def attempt() -> None:
        try:
            move()
        except KeyboardInterrupt:
            send(2)  # more of them in the clean-up
            done.append("cleaned up")
            raise

    with pytest.raises(KeyboardInterrupt):
        attempt()
    assert done == ["cleaned up"]


def test_error_of_uninterrupted_function_is_raised_in_place_of_the_signal() -> None:
    @uninterrupted
    def fail() -> None:
        send()
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        fail()
    assert stopping.requested()
    assert write([], 0) == "result"


def test_third_signal_after_patience_interrupts_a_function_that_hangs(monkeypatch: Any) -> None:
    clock = [0.0]
    monkeypatch.setattr("sliplab.storage.interrupts.time.monotonic", lambda: clock[0])
    seen: list[float] = []

    @uninterrupted
    def hang() -> None:
        while True:
            seen.append(clock[0])
            send()
            clock[0] += 4.0

    with pytest.raises(KeyboardInterrupt):
        hang()
    assert seen == [0.0, 4.0, 8.0, 12.0]


def test_signal_outside_of_files_raises_at_once() -> None:
    with pytest.raises(KeyboardInterrupt):
        send()
