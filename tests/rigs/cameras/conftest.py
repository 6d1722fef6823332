"""Cameras without a camera; waiting is for what happens, never for a time."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest

from rigs.wire.basler import emulate


@pytest.fixture(scope="session")
def pylon_emulation() -> None:
    """pylon lists an emulated camera; before anything in this process has loaded it."""
    emulate(1)


@pytest.fixture
def until() -> Callable[[Callable[[], bool]], None]:
    """Ask again and again until the answer is yes, for at most 20 s."""

    def wait(done: Callable[[], bool]) -> None:
        end = time.monotonic() + 20.0
        while not done():
            assert time.monotonic() < end, "it has not happened within 20 s"

    return wait
