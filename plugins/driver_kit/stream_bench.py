"""Bench of a streaming device: the base of all kinds."""

from __future__ import annotations

import copy
import time
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from sliplab.plugins.driver_kit.bench import POLL_S, QUIET_S, DeviceBench, wraps_s
from sliplab.plugins.driver_kit.rule import Bounds, NotTried, RuleViolation
from sliplab.rigs.core.capabilities import RigError
from sliplab.rigs.core.driver import Driver
from sliplab.storage.streams import I64

FIRST_NS = 5_000_000_000
"""First time of the fakes' clocks, ns."""
BACK_NS = 2_000_000_000
"""Step by which a clock falls back, ns."""
MS_NS = 1_000_000
BATCHES = 3
NUMBER_SLACK = 1e-3
"""Largest error of a force in N, or of a torque in N m."""


class StreamBench(DeviceBench):
    """A device that streams, and its fake, which sends what the bench feeds it."""

    capability: ClassVar[type]
    clock_field: str = "t_ns"
    """Field of a chunk that rises from row to row."""
    fields: tuple[str, ...] = ()
    """Fields of a chunk that must come as they were sent."""
    slack_ns: int = 0
    """Largest error of a time that the driver may make by its rounding, ns."""
    device: Any = None
    fake: Any = None

    _last: tuple[Any, dict[str, Any]] | None = None
    """The last chunk that was read, and a copy of its arrays."""

    def __init__(self, driver: Driver[Any], settings: Any, bounds: Bounds) -> None:
        super().__init__(bounds)
        self.driver, self.settings = driver, settings
        self.fed: list[Any] = []
        self.came: list[Any] = []
        self._next_ns = FIRST_NS
        self._mark: int | None = None

    # -- the fake, by kind -----------------------------------------------------------------

    @abstractmethod
    def feed(self) -> None:
        """Let the fake send the next batch."""

    @abstractmethod
    def silence(self) -> None:
        """Let the fake send and answer nothing from now on."""

    @abstractmethod
    def unplug(self) -> None:
        """Break the connection."""

    def turn_back(self) -> None:
        """Let the device's clock fall back."""
        self._next_ns -= BACK_NS

    def seek(self, t_ns: int) -> None:
        """Let the device's clock show a later time, a whole ms, from the next batch on."""
        self._next_ns = t_ns // MS_NS * MS_NS

    @property
    def wraps_s(self) -> tuple[float, ...]:
        """Times of the device's clock at which counters wrap, s."""
        if self.fake is None:
            raise NotTried("the clock of this bench cannot be set")
        return wraps_s(self.fake)

    def host_ns(self) -> int:
        """Return the host's monotonic clock, ns."""
        return time.monotonic_ns()

    # -- the device ------------------------------------------------------------------------

    def close_device(self) -> None:
        """Close the device, where it was made."""
        if self.device is not None:
            self.device.close()

    def connect(self) -> None:
        """Make the device and connect it, within the bound. Raises Seen or RigError."""
        self.call("connect", self.open, self.bounds.connect_s)

    def begin(self) -> None:
        """Start the stream. Raises RigError."""
        self.device.start()

    def start(self) -> None:
        """Start the stream within the bound. Raises Seen or RigError."""
        self.call("start", self.begin)

    def stop(self) -> None:
        """Stop the stream within the bound. Raises Seen or RigError."""
        self.call("stop", self.device.stop)

    def take(self) -> Any:
        """Return the device's next chunk. Raises RigError."""
        return self.device.read()

    def read(self) -> list[int]:
        """Return the times that came since the last call, in the unit of the chunk."""
        chunk = self.call("read", self.take)
        if self._last is not None and not all(
            np.array_equal(values, self._last[1][name])
            for name, values in vars(self._last[0]).items()
        ):
            raise RuleViolation("a read changed the arrays of the chunk that was read before it")
        if len(chunk):
            self._last = chunk, copy.deepcopy(vars(chunk))
            self.came.append(chunk)
        times: list[int] = getattr(chunk, self.clock_field).tolist()
        return times

    def fault(self) -> bool:
        """Return whether the next read reports a fault."""
        try:
            self.read()
        except RigError:
            return True
        return False

    # -- data ------------------------------------------------------------------------------

    def check_fresh(self, mark: int) -> None:
        """Raise Seen if something besides the chunks came from before a time."""

    def gather(self) -> list[int]:
        """Feed and read some batches; return all times that came.

        Raises:
            Seen: nothing comes, or not all.
            RigError: the driver reports a fault.
        """
        got: list[int] = []

        def first() -> bool:
            self.feed()
            self.wait(POLL_S)
            got.extend(self.read())
            return bool(got)

        if not self.until(first, self.bounds.call_s):
            raise RuleViolation(f"read returned nothing within {self.bounds.call_s:g} s of start")
        self.fed.clear()
        self._mark = self.mark()
        for _ in range(BATCHES):
            self.feed()

        def complete() -> bool:
            try:
                got.extend(self.read())
            except RigError as error:
                if not self.fed:
                    raise
                raise RuleViolation(f"{self.missing(got)}; then {error}") from None
            return self.complete(got)

        if not self.until(complete, self.bounds.call_s):
            raise RuleViolation(
                f"not all that was sent had been read after {self.bounds.call_s:g} s: "
                f"{self.missing(got)}"
            )
        return got

    def missing(self, times: Sequence[int]) -> str:
        """Return in words what was sent last, and what came, in the unit of the chunk."""
        if not self.fed:
            return f"{len(times)} came"
        last = getattr(self.fed[-1], self.clock_field)[-1]
        return f"{self.clock_field} up to {last} was sent, up to {max(times, default=0)} came"

    def flow(self, from_ns: int) -> list[int]:
        """Feed and read some batches from a time on; wait for as many data as were fed.

        Unlike `gather` it takes no time for known, since a counter does not say how often it
        wrapped before.

        Returns:
            their times.

        Raises:
            Seen: not all come.
            RigError: the driver reports a fault before.
        """
        got: list[int] = []

        def read(count: int) -> bool:
            if not count:
                self.feed()
                self.wait(POLL_S)
            got.extend(self.read())
            return len(got) >= max(count, 1)

        if not self.until(lambda: read(0), self.bounds.call_s):
            raise RuleViolation(f"read returned nothing within {self.bounds.call_s:g} s of start")
        self.quiet()
        self.forget()
        got.clear()
        self.seek(from_ns)
        for _ in range(BATCHES):
            self.feed()
        count, then = sum(map(len, self.fed)), ""
        try:
            if self.until(lambda: read(count), self.bounds.call_s):
                return got
        except RigError as error:
            then = f"; then {error}"
        raise RuleViolation(f"{count} were sent and {len(got)} came{then}")

    def forget(self) -> None:
        """Forget what was fed and what came."""
        self.fed.clear()
        self.came.clear()

    def mark(self) -> int | None:
        """Return a time that all data from now on have reached, in the unit of the chunk.

        None where the device restarts its clock at each run.
        """
        return self._next_ns

    def complete(self, times: Sequence[int]) -> bool:
        """Return whether all that was fed has come."""
        last: int = getattr(self.fed[-1], self.clock_field)[-1]
        return bool(times) and times[-1] >= last - self.slack_ns

    def check_content(self) -> None:
        """Raise Seen if what came differs from what `gather` fed last."""
        for name in self.fields:
            sent, found = self._sent_and_found(name)
            if len(sent) != len(found):
                raise RuleViolation(f"{len(sent)} were sent and {len(found)} came ({name})")
            if sent.shape != found.shape:
                raise RuleViolation(f"{name} of shape {found.shape} came, {sent.shape} was sent")
            slack = self.slack_ns if name == "t_ns" else NUMBER_SLACK if _floats(sent) else 0
            off = np.abs(_signed(sent) - _signed(found))
            if not (off <= slack).all():
                wrong = int(np.flatnonzero(~(off <= slack).reshape(len(off), -1).all(axis=1))[0])
                raise RuleViolation(
                    f"{name} came otherwise than it was sent, first in row {wrong}: "
                    f"{_short(found[wrong])} instead of {_short(sent[wrong])}"
                )

    def _sent_and_found(self, name: str) -> tuple[Any, Any]:
        """Return a field of what `gather` fed last, and of what came of it."""
        sent = [getattr(chunk, name) for chunk in self.fed]
        found = [
            getattr(chunk, name)[getattr(chunk, self.clock_field) >= (self._mark or 0)]
            for chunk in self.came
        ]
        return np.concatenate(sent), np.concatenate(found)

    def check_steps(self) -> None:
        """Raise Seen if the times of what `gather` fed last came with other differences."""
        field = self.clock_field
        sent = np.concatenate([getattr(chunk, field) for chunk in self.fed])
        found = np.concatenate([getattr(chunk, field) for chunk in self.came])[-len(sent) :]
        off = np.abs(np.diff(found) - np.diff(sent)).max() if len(found) == len(sent) else None
        if off is None or off > 2 * self.slack_ns:
            raise RuleViolation(
                f"times from {sent[0]} to {sent[-1]} came as {found[0]} to {found[-1]} ({field})"
            )

    def times(self, count: int, step_ns: int) -> I64:
        """Return the next times of the fake's clock, ns, shape (count,)."""
        found = self._next_ns + step_ns * np.arange(count, dtype=np.int64)
        self._next_ns += count * step_ns
        return found

    def quiet(self) -> list[int]:
        """Return the times that are read within `QUIET_S`."""
        got = self.read()
        self.wait(QUIET_S)
        return [*got, *self.read()]


def _floats(values: Any) -> bool:
    return bool(values.dtype.kind == "f")


def _signed(values: Any) -> Any:
    """Return numbers whose differences do not wrap."""
    return values if _floats(values) else values.astype(np.int64)


def _short(value: Any) -> str:
    """Return a row in few words: an image by its shape."""
    return (
        f"{value}" if np.size(value) <= 6 else f"{np.shape(value)} values of {np.mean(value):.1f}"
    )
