"""Cameras without a camera; waiting is for what happens, never for a time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from sliplab.rigs.wire.basler import emulate

LIMIT_S, LOOK_S = 60.0, 0.002


@pytest.fixture(scope="session")
def pylon_emulation() -> None:
    """pylon lists an emulated camera; before anything in this process has loaded it."""
    emulate(1)


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    """Ask until the answer is yes, for at most 60 s, 500 times a second.

    Between questions the interpreter is free: a loop that never lets go of it starves the
    drivers' threads, which a rig's loop never does.
    """
    idle = threading.Event()

    def wait(done: Callable[[], bool]) -> None:
        end = time.monotonic() + LIMIT_S
        while not done():
            assert time.monotonic() < end, f"it has not happened within {LIMIT_S:g} s"
            idle.wait(LOOK_S)

    return wait
