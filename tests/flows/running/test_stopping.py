"""A stop request is never lost, wherever the signal finds the program."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from flows.running import console, stopping


def test_a_signal_interrupts_and_is_remembered() -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        with stopping.signals():
            assert not stopping.requested()
            with pytest.raises(KeyboardInterrupt):
                os.kill(os.getpid(), number)
            assert stopping.requested()
            with pytest.raises(KeyboardInterrupt):
                stopping.check()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_signal_that_python_drops_is_remembered() -> None:
    """In a destructor the exception is printed and dropped; the flag stays."""

    class Unlucky:
        def __del__(self) -> None:
            os.kill(os.getpid(), signal.SIGINT)

    with stopping.signals():
        unlucky = Unlucky()
        del unlucky
        assert stopping.requested()
        with pytest.raises(KeyboardInterrupt), console.bar("work", 1) as bar:
            bar.advance()


def test_handlers_are_put_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    with stopping.signals():
        assert signal.getsignal(signal.SIGINT) is not before
    assert signal.getsignal(signal.SIGINT) is before


@pytest.fixture(autouse=True)
def forget() -> Iterator[None]:
    """No request outlives its test."""
    yield
    with stopping.signals():
        pass
