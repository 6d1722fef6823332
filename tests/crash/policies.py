"""Policies for intercepted calls: kill the process, fill its disk, record the calls."""

from __future__ import annotations

import errno
import os
import signal
from collections import Counter
from dataclasses import dataclass, field

from tests.crash.hooks import WRITING, Call


@dataclass
class Killer:
    """Kills its own process at one call.

    Attributes:
        kind: write, fsync, rename or any: which calls are counted.
        at: the number of the call.
        share: of a write's bytes that still reach the file; other calls are made first when it is
            over a half.
        name: part of the paths whose calls are counted.
    """

    kind: str
    at: int
    share: float
    name: str = ""
    seen: int = 0

    def __call__(self, call: Call) -> int:
        """Make the call, or die in it."""
        if self.kind not in {"any", call.kind} or self.name not in f"{call.path} {call.to}":
            return call.go()
        self.seen += 1
        if self.seen < self.at:
            return call.go()
        if call.kind == "write":
            call.go(int(call.size * self.share))
        elif self.share > 0.5:
            call.go()
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("outlived a SIGKILL")


@dataclass
class Full:
    """A disk with room for so many bytes more.

    A write that passes the end puts in what still fits, as a file system does, and the next one is
    refused. Bytes over what a file already has are free, and what is deleted makes no room.
    """

    room: int
    number: int = errno.ENOSPC
    refused: int = 0

    def __call__(self, call: Call) -> int:
        """Make the call as far as there is room."""
        if call.kind != "write":
            return call.go()
        grows = max(0, call.offset + call.size - os.stat(call.path).st_size)
        if grows <= self.room:
            self.room -= grows
            return call.go()
        fits = call.size - grows + self.room
        self.room = 0
        if fits > 0:
            return call.go(fits)
        self.refused += 1
        return call.fail(self.number)


@dataclass
class ReadOnly:
    """A file system that is mounted read-only."""

    asked: Counter[str] = field(default_factory=Counter)

    def __call__(self, call: Call) -> int:
        """Refuse whatever would change something."""
        self.asked[call.kind] += 1
        changes = call.kind != "open" or call.flags & WRITING
        return call.fail(errno.EROFS) if changes and call.kind != "fsync" else call.go()


@dataclass(frozen=True)
class Done:
    """A call that was made: its kind, paths, and what it wrote."""

    kind: str
    path: str
    to: str = ""
    offset: int = 0
    data: bytes = b""
    size: int = 0


@dataclass
class Recorder:
    """Makes every call, and keeps those that changed something in their order."""

    done: list[Done] = field(default_factory=list)

    def __call__(self, call: Call) -> int:
        """Make the call and note it when it was successful."""
        new = call.kind == "open" and not os.path.lexists(call.path)
        kind = "create" if new else "truncate" if call.flags & os.O_TRUNC else call.kind
        result = call.go()
        if result < 0 or kind == "open":
            return result
        data = call.data[:result] if kind == "write" else b""
        # noted under the name that the file has in the end of the call
        self.done.append(Done(kind, call.path, call.to, call.offset, data, call.size))
        return result
