"""A fake of the example sync box, that ticks by a given clock and serves its lines."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast, get_args

from sliplab.protocols.timing import Code
from sliplab.rigs.core.driver import OnTrain, PulseTrain
from sliplab.rigs.core.fakes import FakeStream
from sliplab.rigs.core.pulse_code import SEEDS, CodeBits

TURN_S = 0.001
"""Period at which due pulses are sent, s."""


class FakeExampleSync(FakeStream):
    """A `sliplab.rigs.core.driver.FakeBox`.

    Args:
        now_ns: the clock that drives it, ns.
        on_train: called with each train, and at its end.
    """

    def __init__(self, now_ns: Callable[[], int], on_train: OnTrain) -> None:
        self._now_ns, self._on_train = now_ns, on_train
        self._train: PulseTrain | None = None
        self._zero_ns, self._sent, self.pulses = now_ns(), 0, 0
        self._late, self._held = False, ""
        super().__init__("fake sync box")

    def reset(self) -> None:
        """Restart as after a brown-out: no train, and a clock that starts again at zero."""
        self._thread.call(self._end)
        self._zero_ns = self._now_ns()
        self.write(b"BOOT\n")

    def answer_late(self) -> None:
        """Hold the answer to the next request back until the one after it."""
        self._late = True

    def expose(self) -> None:
        """Simulate an exposure of the frame camera, whose output is wired to the box."""
        self.write(f"EXPOSURE {(self._now_ns() - self._zero_ns) // 1000}\n".encode())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        self._held = ""
        self._tick()
        try:
            while line := await reader.readline():
                answer = f"{self._answer(line.decode('ascii').split())}\n"
                if self._late:
                    self._late, self._held = False, answer
                    continue
                self._write((self._held + answer).encode())
                self._held = ""
        finally:
            self._timer.cancel()
            self._end()

    def _answer(self, words: list[str]) -> str:
        if words[0] == "START":
            rate_hz, seed, code = float(words[1]), int(words[2]), words[3]
            if not (1 <= rate_hz <= 1000 and 1 <= seed <= SEEDS and code in get_args(Code)):
                return "ERROR no such train"
            self._end()
            self._zero_ns, self._sent, self.pulses = self._now_ns(), 0, 0
            self._train = PulseTrain(self._zero_ns, rate_hz, seed, cast(Code, code))
            self._bits = CodeBits(seed, cast(Code, code))
            self._on_train(self._train, 0)
            return "STARTED 0"
        if words[0] == "STOP":
            self._end()
        word = {"STOP": "STOPPED", "CLOCK": "CLOCK"}[words[0]]
        return f"{word} {(self._now_ns() - self._zero_ns) // 1000}"

    def _end(self) -> None:
        if self._train is not None:
            self._train = None
            self._on_train(None, self._sent)

    def _tick(self) -> None:
        """Send the pulses that are due; again after `TURN_S`."""
        self._timer = asyncio.get_running_loop().call_later(TURN_S, self._tick)
        if self._train is None:
            return
        period_ns = 1e9 / self._train.rate_hz
        due = int((self._now_ns() - self._zero_ns) / period_ns) + 1
        for tick in range(self._sent, due):
            if self._bits.upto(due)[tick]:
                self.pulses += 1
                self._write(f"PULSE {round(tick * period_ns / 1000)}\n".encode())
        self._sent = due
