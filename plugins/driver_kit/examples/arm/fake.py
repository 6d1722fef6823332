"""A fake controller of the example arm, that speaks its lines."""

from __future__ import annotations

import asyncio

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.driver import ArmScene
from sliplab.rigs.core.fakes import CLOCK_BACK_S, Kind, ServedController

ACCELERATION_MM_S2 = 500.0
PERIOD_S = 0.002
STATES = {
    Kind.PROTECTIVE_STOP: "PROTECTIVE",
    Kind.EMERGENCY_STOP: "EMERGENCY",
    Kind.PROGRAM_END: "OFF",
    Kind.POWER_OFF: "OFF",
}


class FakeExampleArm(ServedController):
    """One fake controller at an address."""

    def __init__(self, host: str, port: int, scene: ArmScene) -> None:
        super().__init__(host, scene.motion, scene.clock)
        self._port, self._sync = port, scene.sync
        self._stopped, self._silent, self._back_s = "", False, 0.0
        self._late, self._held = False, ""

    def restore(self) -> None:
        """Clear every fault, as a person would."""
        self._inside(self._connections.cut)
        self._stopped, self._silent, self._late = "", False, False
        self._inside(self._listen)

    def _listen(self) -> None:
        self._connections.listen(self.host, self._port, self._serve)

    def _inject(self, kind: Kind) -> None:
        if kind is Kind.LINK_CUT:
            self._connections.cut()
        elif kind is Kind.SILENCE:
            self._silent = True
        elif kind is Kind.CLOCK_BACK:
            self._back_s += CLOCK_BACK_S
        elif kind is Kind.LATE_ANSWER:
            self._late = True
        elif kind in STATES:
            self._stopped = STATES[kind]
            self._halt()
        else:
            raise ValueError(f"{kind.value} is not simulated: this controller does not report it")

    def _halt(self) -> None:
        self.motion.stop(ACCELERATION_MM_S2, self.clock.now_s())

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._held = ""
        self._send_pose(writer)
        try:
            while line := await reader.readline():
                answer = self._answer(line.decode("ascii").split())
                if self._late:
                    self._late, self._held = False, answer
                elif not self._silent:
                    writer.write((self._held + answer).encode())
                    self._held = ""
        finally:
            self._timer.cancel()
            self._halt()  # it stops when its client leaves

    def _answer(self, words: list[str]) -> str:
        now_s = self.clock.now_s()
        if words[0] == "MOVE" and self._stopped:
            return f"ERROR {self._stopped}\n"
        if words[0] == "MOVE":
            x, y, z, a, b, c, speed = map(float, words[1:])
            self.motion.move(Pose((x, y, z), (a, b, c)), speed, ACCELERATION_MM_S2, now_s)
        else:
            self._halt()
        return f"OK {self._us(now_s)}\n"

    def _send_pose(self, writer: asyncio.StreamWriter) -> None:
        if not self._silent:
            writer.write(self._pose().encode())
        loop = asyncio.get_running_loop()
        self._timer = loop.call_later(PERIOD_S, self._send_pose, writer)

    def _pose(self) -> str:
        now_s = self.clock.now_s()
        pose = self.motion.pose(now_s)
        numbers = " ".join(f"{value:.6f}" for value in (*pose.xyz_mm, *pose.rotvec_deg))
        state = self._stopped or ("MOVING" if self.motion.moving(now_s) else "READY")
        return f"POSE {self._us(now_s)} {numbers} {state} {int(self._sync(now_s))}\n"

    def _us(self, now_s: float) -> int:
        return round((now_s - self._back_s) * 1e6)
