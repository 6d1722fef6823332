"""A fake sync box on a pty: the firmware's protocol in real time, with faults on request.

The driver opens it like a board, so its complete path is tested without one. The clock is a
callable, so that a simulated scene can drive it.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Self, get_args

from sliplab.plugins.devices.sync_box.line import (
    ALL_TO_HZ,
    LEAST_HZ,
    MOST_HZ,
    NAME,
    LineReader,
    seal,
)
from sliplab.protocols.timing import Code
from sliplab.rigs.core.driver import OnTrain, PulseTrain
from sliplab.rigs.core.fakes import FakeSerial
from sliplab.rigs.core.pulse_code import SEEDS, CodeBits

TURN_S = 0.001
"""Period at which the fake sends due reports."""
LEAD_US = 2000
"""Time from GO to tick 0."""
CODES: dict[str, Code] = {code: code for code in get_args(Code)}


@dataclass(frozen=True)
class _Plan:
    """A train as requested by ARM: `last` ticks, 0 for endless."""

    millihertz: int
    last: int
    seed: int
    code: Code

    @cached_property
    def bits(self) -> CodeBits:
        """Bits of the code, tick by tick."""
        return CodeBits(self.seed, self.code)


class FakeSyncBox(FakeSerial):
    """A fake sync box on the pty `address`; a context manager that ends its thread.

    Args:
        now_ns: the box's clock with any origin; the box reports 0 at power-on and reset.
        exposure_us: delay of each exposure after its tick; None if the camera's output is not
            wired.
        on_train: called in the box's thread with every train before its first tick, and at its end
            with None and the number of ticks sent.

    Attributes:
        pulses: number of pulses (code bits 1) of the running or last train.
    """

    def __init__(
        self,
        now_ns: Callable[[], int] = time.monotonic_ns,
        on_train: OnTrain = lambda train, sent: None,
        exposure_us: int | None = None,
    ) -> None:
        self._now_ns, self._exposure_us, self._on_train = now_ns, exposure_us, on_train
        self._corrupt, self._drop = 0, 0
        self._late, self._held = False, b""
        self._train: _Plan | None = None
        self._sent = self.pulses = 0
        self._power_on()
        super().__init__("pty sync box")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- faults ----------------------------------------------------------------------------

    def reset(self, announced: bool = True) -> None:
        """Restart as after a brown-out: no train, clock at 0, and the board's start message."""
        self._thread.call(self._power_on)
        if announced:
            self._thread.call(lambda: self._say(f"B {NAME}"))

    def answer_late(self) -> None:
        """Hold the answer to the next request back until the one after it."""
        self._late = True

    def corrupt(self, lines: int) -> None:
        """Garble the next `lines` sent lines."""
        self._corrupt = lines

    def drop(self, reports: int) -> None:
        """Drop the next `reports` reports as with a full buffer; their number is reported."""
        self._drop = reports

    def expose(self) -> None:
        """Simulate an exposure of the camera now, whose output is wired to the box."""
        self._thread.call(lambda: self._stamps.append(self._us()))

    # -- the box ---------------------------------------------------------------------------

    def _announce(self, plan: _Plan) -> None:
        first_ns = self._origin_ns + self._first_us * 1000
        self._on_train(PulseTrain(first_ns, plan.millihertz / 1000, plan.seed, plan.code), 0)

    def _end(self) -> None:
        if self._train is not None:
            self._train = None
            self._on_train(None, self._sent)

    def _power_on(self) -> None:
        self._end()
        self._origin_ns = self._now_ns()
        self._lines = LineReader()
        self._armed: _Plan | None = None
        self._first_us = self._sent = self._exposed = self._dropped = self._reported = self.lost = 0
        self._stamps: list[int] = []

    def _us(self) -> int:
        return (self._now_ns() - self._origin_ns) // 1000

    def _say(self, body: str) -> None:
        if self._silent:
            return
        line = seal(body)
        if self._corrupt:
            self._corrupt -= 1
            line = line[:-3] + b"??\n"
        if body[0] not in "PXDB":  # an answer
            if self._late:
                self._late, self._held = False, line
                return
            line, self._held = self._held + line, b""
        self._write(line)

    def _report(self, body: str) -> None:
        if self._drop:
            self._drop -= 1
            self._dropped += 1
        else:
            self._say(body)

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        self._turn()
        try:
            while data := await reader.read(4096):
                for body in self._lines.bodies(data):
                    try:
                        self._obey(body)
                    except ValueError:
                        self._say("E unknown")
                for _ in range(self._lines.wrong):
                    self._say("E checksum")
                self._lines.wrong = 0
        finally:
            self._timer.cancel()
            self._end()

    def _turn(self) -> None:
        """Send the reports that are due; again after `TURN_S`."""
        self._timer = asyncio.get_running_loop().call_later(TURN_S, self._turn)
        if not self._silent:
            self._tick()

    def _tick(self) -> None:
        """Send the reports that are due."""
        now_us = self._us()
        if self._train is not None:
            train, first_us = self._train, self._first_us
            due = (now_us - first_us) * train.millihertz // 1_000_000_000 + 1
            due = min(due, train.last or due)
            bits = train.bits.upto(max(due, 0))
            for number in range(self._sent, due):
                us = first_us + number * 1_000_000_000 // train.millihertz
                self.pulses += int(bits[number])
                if bits[number] or train.millihertz <= ALL_TO_HZ * 1000:
                    self._report(f"P {number} {bits[number]} {us}")
                if self._exposure_us is not None:
                    self._stamps.append(us + self._exposure_us)
            self._sent = max(self._sent, due)
            if train.last and self._sent == train.last:
                self._end()
        while self._stamps and self._stamps[0] <= now_us:
            self._report(f"X {self._exposed} {self._stamps.pop(0)}")
            self._exposed += 1
        dropped = self._dropped + self.lost
        if dropped != self._reported:
            self._reported = dropped
            self._say(f"D {dropped}")

    def _obey(self, body: str) -> None:
        command, _, rest = body.partition(" ")
        if body == "ID?":
            self._say(f"ID {NAME}")
        elif command == "T?" and rest.isdecimal():
            self._say(f"T {rest} {self._us()}")
        elif command == "ARM":
            self._arm(rest.split(" "))
        elif body == "GO":
            if self._armed is not None:
                self._train, self._armed = self._armed, None
                self._first_us = self._us() + LEAD_US
                self._announce(self._train)
            if self._train is None:
                self._say("E not armed")
            else:
                self._say(f"OK GO {self._first_us}")
        elif body == "STOP":
            self._tick()
            self._end()
            self._armed = None
            self._say(f"OK STOP {self._sent}")
        else:
            self._say("E unknown")

    def _arm(self, words: list[str]) -> None:
        hz, seed, ticks, code = words
        if self._train is not None:
            self._say("E running")
        elif not LEAST_HZ <= float(hz) <= MOST_HZ:
            self._say("E rate must be 1 to 1000 Hz")
        elif not 1 <= int(seed) <= SEEDS:
            self._say(f"E seed must be 1 to {SEEDS}")
        elif code not in CODES:
            self._say("E code must be lfsr, irregular or regular")
        else:
            self._armed = _Plan(round(float(hz) * 1000), int(ticks), int(seed), CODES[code])
            self._sent = self._exposed = self._dropped = self._reported = 0
            self.pulses = self.lost = 0
            self._stamps = []
            self._say("OK ARM")
