"""A fake controller of the lab stage, that speaks its lines on a loopback address."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion
from sliplab.rigs.core.fakes import Kind, ServedController

ACCELERATION_MM_S2 = 500.0
POSES_HZ = 500
ABOUT = "stage-3-fake S0000 1.2"
STATES = {
    Kind.PROTECTIVE_STOP: "PROTECTIVE",
    Kind.EMERGENCY_STOP: "EMERGENCY",
    Kind.PROGRAM_END: "OFF",
    Kind.POWER_OFF: "OFF",
}


class FakeLabStage(ServedController):
    """One fake controller.

    Args:
        host, motion, clock: as of any `FakeController`.
        port: of the controller.
        sync: level of the input at a time of the controller's clock, s.
    """

    def __init__(
        self,
        host: str,
        port: int = 7300,
        motion: StraightMotion | None = None,
        clock: ControllerClock | None = None,
        sync: Callable[[float], bool] = lambda t_s: False,
    ) -> None:
        super().__init__(host, motion, clock)
        self.port, self._sync = port, sync
        self._stopped, self._silent = "", False
        self._late, self._held = False, ""
        self._back_s = 0.0
        self._client: asyncio.StreamWriter | None = None

    def restore(self) -> None:
        """Put link and safety right, as a person would."""
        self._inside(self._connections.cut)
        self._stopped, self._silent, self._late = "", False, False
        self._inside(self._listen)

    def _listen(self) -> None:
        self._connections.listen(self.host, self.port, self._talk)

    def _inject(self, kind: Kind) -> None:
        if kind is Kind.LINK_CUT:
            self._connections.cut()
        elif kind is Kind.SILENCE:
            self._silent = True
        elif kind is Kind.CLOCK_BACK:
            self._back_s += 5.0
        elif kind is Kind.LATE_ANSWER:
            self._late = True
        elif kind not in STATES:
            raise ValueError(f"{kind.value} is not simulated: this controller does not report it")
        else:
            self._stopped = STATES[kind]
            self._halt()

    def _halt(self) -> None:
        self.motion.stop(ACCELERATION_MM_S2, self.clock.now_s())

    async def _talk(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self._client is not None:
            return  # one client: another one finds the door closed again
        self._client, self._held = writer, ""
        poses = asyncio.get_running_loop().create_task(self._tell(writer))
        try:
            while line := await reader.readline():
                answer = self._answer(line.decode("ascii").split())
                if self._late:
                    self._late, self._held = False, answer
                elif not self._silent:
                    writer.write((self._held + answer).encode())
                    self._held = ""
        finally:
            self._client = None
            self._halt()
            poses.cancel()

    def _answer(self, words: list[str]) -> str:
        number, word, *values = words
        if word == "HELLO":
            return f"{number} OK {ABOUT}\n"
        if word == "STOP":
            self._halt()
            return f"{number} OK\n"
        if word != "MOVE" or len(values) != 4:
            return f"{number} ERROR unknown request\n"
        if self._stopped:
            return f"{number} ERROR stopped\n"
        x, y, z, speed = map(float, values)
        now_s = self.clock.now_s()
        to = Pose((x, y, z), self.motion.pose(now_s).rotvec_deg)
        self.motion.move(to, speed, ACCELERATION_MM_S2, now_s)
        return f"{number} OK {round(now_s * 1e6)}\n"

    async def _tell(self, writer: asyncio.StreamWriter) -> None:
        loop = asyncio.get_running_loop()
        while True:
            if not self._silent:
                writer.write(self._pose_line().encode())
            tick: asyncio.Future[None] = loop.create_future()
            loop.call_later(1 / POSES_HZ, _end, tick)
            await tick

    def _pose_line(self) -> str:
        now_s = self.clock.now_s()
        x, y, z = self.motion.pose(now_s).xyz_mm
        state = self._stopped or ("MOVING" if self.motion.moving(now_s) else "READY")
        t_us, level = round((now_s - self._back_s) * 1e6), int(self._sync(now_s))
        return f"POSE {t_us} {x:.4f} {y:.4f} {z:.4f} {state} {level}\n"


def _end(tick: asyncio.Future[None]) -> None:
    if not tick.done():
        tick.set_result(None)
