"""The time and the disk space of a simulated host, handed to one forked process."""

from __future__ import annotations

import datetime as real
import json
import os
import shutil
import sys
import time
from collections import namedtuple
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from sliplab.plugins.simulation.world import SimulatedWorld
from tests.patching import put

BEGIN_S = 1_795_456_800.0
"""Time of the host when a story begins, seconds since 1970: the past, for caches have dates."""
_Usage = namedtuple("_Usage", ("total", "used", "free"))


class Notes:
    """What a process tells those who outlive it: one JSON object a line, in the file at once."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def add(self, **note: Any) -> None:
        """Append a note; a kill right after it does not lose it."""
        handle = os.open(self.path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
        try:
            os.write(handle, (json.dumps(note) + "\n").encode())
        finally:
            os.close(handle)

    def take(self) -> list[dict[str, Any]]:
        """Return the notes so far, and forget them."""
        if not self.path.exists():
            return []
        found = [json.loads(line) for line in self.path.read_text().splitlines()]
        self.path.unlink()
        return found


@cache
def modules_with_dates() -> list[ModuleType]:
    """Return the program's modules that ask for dates; found once, for all processes."""
    loaded = [module for name, module in sys.modules.items() if name.startswith("sliplab")]
    return [module for module in loaded if vars(module).get("datetime") is real.datetime]


class Host:
    """A host whose time passes only where the simulated rig waits, or the collection does.

    Attributes:
        wall_s: what its clock shows, seconds since 1970. rig_s: virtual time of the rig so far.
        free: bytes on its disk.
        events: what happens in a night, in order: seconds of `passed_s`, and what to do.
    """

    def __init__(self, wall_s: float, notes: Notes, free: int = 50_000_000_000) -> None:
        self.wall_s, self.notes, self.free = wall_s, notes, free
        self.passed_s = self.rig_s = 0.0
        self.events: list[tuple[float, Callable[[], None]]] = []
        self.most_s = 1e9

    def install(self) -> None:
        """Give this process the host's clock and disk, until it ends."""
        host = self

        class Datetime(real.datetime):
            @classmethod
            def now(cls, tz: real.tzinfo | None = None) -> Datetime:
                return cls.fromtimestamp(host.wall_s, tz)

        for module in modules_with_dates():
            put(module, "datetime", Datetime)
        time.time = lambda: host.wall_s
        put(shutil, "disk_usage", lambda folder: _Usage(10**12, 10**12 - host.free, host.free))
        pass_time = SimulatedWorld.pass_time

        def passing(world: SimulatedWorld, ns: int) -> None:
            pass_time(world, ns)
            self.rig_s += ns / 1e9
            self.wait(ns / 1e9)

        put(SimulatedWorld, "pass_time", passing)

    def wait(self, seconds: float) -> None:
        """Let time pass, with what happens in it."""
        self.wall_s += seconds
        self.passed_s += seconds
        if self.passed_s > self.most_s:
            self.notes.add(wrong="waits are bounded", what=f"{self.passed_s:.0f} s and no end")
            os._exit(97)
        while self.events and self.events[0][0] <= self.passed_s:
            self.events.pop(0)[1]()
