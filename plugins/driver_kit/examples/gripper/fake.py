"""A fake of the example gripper, that moves the fingers of a scene and serves its lines."""

from __future__ import annotations

import asyncio

import numpy as np

from sliplab.plugins.driver_kit.examples.gripper import RANGE
from sliplab.rigs.core.driver import GripperScene
from sliplab.rigs.core.fakes import FakeStream


class FakeExampleGripper(FakeStream):
    """A `sliplab.rigs.core.driver.FakeGripper`.

    Args:
        scene: its fingers go at the speed of a move, and stall at an object by its force.
    """

    def __init__(self, scene: GripperScene) -> None:
        self._fingers, self._now_ns = scene.fingers, scene.now_ns
        self._failed = False
        super().__init__("fake gripper")

    def fail(self) -> None:
        """Report a fault from now on, and stop."""
        self._failed = True
        self._fingers.stop(self._now_ns())

    async def _serve(self, reader: asyncio.StreamReader) -> None:
        while line := await reader.readline():
            self._take(line.decode("ascii").split())

    def _take(self, words: list[str]) -> None:
        now_ns = self._now_ns()
        if words[0] == "STATE":
            self._write(f"STATE {words[1]} {self._steps(now_ns)} {self._word(now_ns)}\n".encode())
        elif words[0] == "MOVE" and not self._failed:
            steps, speed_mm_s, force_n = map(float, words[1:])
            self._fingers.move(steps * RANGE.step_mm, speed_mm_s, force_n, now_ns)
        elif words[0] == "STOP" and self._fingers.moving(now_ns):
            self._fingers.stop(now_ns)

    def _steps(self, now_ns: int) -> int:
        opening_mm = self._fingers.opening_mm(np.array([now_ns], np.int64))[0]
        return round(float(opening_mm) / RANGE.step_mm)

    def _word(self, now_ns: int) -> str:
        if self._failed:
            return "FAULT"
        if self._fingers.moving(now_ns):
            return "MOVING"
        return "STALLED" if self._fingers.stalled else "READY"
