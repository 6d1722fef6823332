"""Bench: one driver on its fake, with bounded calls and bounded waiting."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from typing import Self, TypeVar

from sliplab.plugins.driver_kit.rule import Bounds, RuleViolation
from sliplab.rigs.core.capabilities import RigError

T = TypeVar("T")
POLL_S = 0.005
QUIET_S = 0.2
"""Time for which the bench watches that nothing more happens, s."""
SETTLE_S = 2.0
"""Time for closed connections to disappear from this process, s."""
_FILES = "/proc/self/fd"


COMMON_WRAPS_S = (2**31 / 1e6, 2**31 / 1e3, 2**32 / 1e3)
"""Times at which counters of 32 bits wrap, s: signed ones of us and of ms, and unsigned ones of
either, whose us wrap there for the thousandth time."""


def wraps_s(fake: object) -> tuple[float, ...]:
    """Return when a counter on a fake's wire wraps, s of its clock.

    A fake whose counter does not count us or ms says so by an attribute `wraps_ns`.
    """
    own = [wrap_ns / 1e9 for wrap_ns in getattr(fake, "wraps_ns", ())]
    return (*own, *COMMON_WRAPS_S)


def held() -> tuple[int, int, int]:
    """Return the numbers of threads, child processes, and open files and sockets of this process.

    Pipes are left out: libraries keep them as long as an object of theirs lives.
    """
    files = 0
    for handle in os.listdir(_FILES) if os.path.isdir(_FILES) else ():
        with suppress(OSError):  # closed meanwhile
            files += os.readlink(f"{_FILES}/{handle}").startswith(("socket:", "/"))
    return threading.active_count(), len(multiprocessing.active_children()), files


def settle() -> None:
    """Wait until what this process has open no longer changes, `SETTLE_S` at most."""
    end, before = time.monotonic() + SETTLE_S, held()
    while time.monotonic() < end:
        threading.Event().wait(QUIET_S)
        now = held()
        if now == before:
            return
        before = now


class DeviceBench(ABC):
    """A device on its fake; a context manager that closes both.

    Args:
        bounds: time limits of the driver's calls.
    """

    def __init__(self, bounds: Bounds) -> None:
        self.bounds = bounds
        self._held = held()
        self.last_call = "nothing"
        """Name of the call that was made last, for messages."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        with suppress(RuleViolation, RigError):
            self.call("close", self.close_device, self.bounds.call_s)
        self.close_fake()

    def left_open(self) -> str:
        """Return the resources opened since before the fake and still open; empty if none."""
        words = ("threads", "child processes", "files or sockets")
        return ", ".join(
            f"{now - then} {word}"
            for word, then, now in zip(words, self._held, held(), strict=True)
            if now > then
        )

    @abstractmethod
    def open(self) -> None:
        """Make the device and connect it. Raises RigError."""

    @abstractmethod
    def close_device(self) -> None:
        """Close the device, where it was made."""

    @abstractmethod
    def close_fake(self) -> None:
        """Close the fake."""

    def wait(self, seconds: float) -> None:
        """Let `seconds` pass on the device's clock."""
        threading.Event().wait(seconds)

    def call(self, name: str, work: Callable[[], T], within_s: float | None = None) -> T:
        """Return the result of a call of the driver, made in a separate thread.

        Args:
            within_s: its time limit; that of most calls if left out.

        Raises:
            Seen: it has not returned in time, or raised something else than a RigError.
            RigError: raised by the driver.
        """
        self.last_call = name
        limit_s = self.bounds.call_s if within_s is None else within_s
        results: list[T] = []
        errors: list[BaseException] = []

        def run() -> None:
            try:
                results.append(work())
            except BaseException as error:  # raised again below
                errors.append(error)

        thread = threading.Thread(target=run, name=f"conformance: {name}", daemon=True)
        thread.start()
        thread.join(limit_s)
        if thread.is_alive():
            raise RuleViolation(f"{name} had not returned after {limit_s:g} s")
        if not errors:
            return results[0]
        if isinstance(errors[0], (RigError, RuleViolation)):
            raise errors[0]
        raise RuleViolation(f"{name} raised {errors[0]!r}, which is no RigError") from errors[0]

    def refusal(
        self, name: str, work: Callable[[], object], within_s: float | None = None
    ) -> RigError | None:
        """Return the RigError that a call raises; None if it raises none. Raises Seen as `call`."""
        try:
            self.call(name, work, within_s)
        except RigError as error:
            return error
        return None

    def until(self, condition: Callable[[], bool], within_s: float) -> bool:
        """Return whether a condition becomes true in time."""
        end = time.monotonic() + within_s
        while not condition():
            if time.monotonic() > end:
                return False
            self.wait(POLL_S)
        return True


def check_methods(device: object, capability: type) -> None:
    """Raise Seen if a device lacks a method or an attribute of its capability."""
    wanted = {*vars(capability), *capability.__annotations__}
    missing = sorted(n for n in wanted if not n.startswith("_") and not hasattr(device, n))
    if missing:
        raise RuleViolation(f"it has no {', '.join(missing)}")


def check_close(bench: DeviceBench) -> None:
    """Open and close the device twice, and close the fake; nothing may be left of either.

    Raises:
        Seen: something stays open, or a second `close` fails.
    """
    for _ in range(2):
        bench.call("connect", bench.open, bench.bounds.connect_s)
        bench.call("close", bench.close_device)
        error = bench.refusal("a second close", bench.close_device)
        if error is not None:
            raise RuleViolation(f"a second close raised {error!r}")
    bench.close_fake()
    if not bench.until(lambda: not bench.left_open(), SETTLE_S):
        raise RuleViolation(f"after close {bench.left_open()} stayed open")
