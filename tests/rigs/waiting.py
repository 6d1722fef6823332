"""Helpers of tests of drivers and fakes: own addresses, and bounded waiting."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable

_COUNT = itertools.count(1)


def own_address() -> str:
    """A loopback address that no other test process and no other test of this one uses."""
    pid = os.getpid()
    return f"127.{1 + (pid >> 8) % 250}.{pid % 256}.{1 + next(_COUNT) % 250}"


def until(condition: Callable[[], bool], within_s: float) -> float:
    """Wait for a condition; how long it took, s. Fails after `within_s`."""
    began = time.monotonic()
    poll = threading.Event()
    while not condition():
        assert time.monotonic() - began < within_s, f"not true within {within_s:g} s"
        poll.wait(0.002)
    return time.monotonic() - began
