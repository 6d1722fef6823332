"""Helpers of tests of drivers and fakes: own addresses, and bounded waiting."""

from __future__ import annotations

import itertools
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import Chunk

_COUNT = itertools.count(1)
ChunkT = TypeVar("ChunkT", bound=Chunk)


def own_address() -> str:
    """A loopback address that no other test process and no other test of this one uses."""
    pid = os.getpid()
    return f"127.{1 + (pid >> 8) % 250}.{pid % 256}.{1 + next(_COUNT) % 250}"


def until(condition: Callable[[], object], within_s: float = 60.0) -> float:
    """Wait for a condition; how long it took, s. Fails after `within_s`."""
    began = time.monotonic()
    poll = threading.Event()
    while not condition():
        assert time.monotonic() - began < within_s, f"not true within {within_s:g} s"
        poll.wait(0.002)
    return time.monotonic() - began


def gather(read: Callable[[], ChunkT], rows: int, within_s: float = 60.0) -> ChunkT:
    """Read until there are so many rows; return all of them as one chunk."""
    parts: list[ChunkT] = []

    def enough() -> bool:
        parts.append(read())
        return sum(map(len, parts)) >= rows

    until(enough, within_s)
    return type(parts[0]).concatenate([part for part in parts if len(part)])


def fault_of(call: Callable[[], object], within_s: float) -> str:
    """Call again and again; return the text of the fault in which that ends in time."""
    found: list[str] = []

    def fails() -> bool:
        try:
            call()
        except RigError as fault:
            found.append(str(fault))
        return bool(found)

    until(fails, within_s)
    return found[0]


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port of this host that nobody has now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
