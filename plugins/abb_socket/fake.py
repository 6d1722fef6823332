"""A fake of the small RAPID socket server on an ABB controller (port 5000).

It serves one client at a time: a second connection is accepted, but not answered until the first
has closed. A fly-by move is answered inside its zone, so that the next one can follow without a
stop; a fine-point move is answered at rest. A move that a safety stop ends is never answered. If
the client disconnects during a move, the move ends before the next client is served. Requests that
are not simulated are refused.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Sequence

from sliplab.plugins.abb_socket.wire import ARGUMENTS, ServerCommand
from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion
from sliplab.rigs.core.fakes import (
    Fault,
    FaultPlan,
    Kind,
    ServedController,
    Stage,
)
from sliplab.rigs.core.pose import distance_mm, from_quaternion, quaternion

JOINTS_DEG = (0.0, 10.0, 20.0, 0.0, 60.0, 0.0)
ACCELERATION_MM_S2 = 500.0
INFO = b"SlipLab stand-in of a RAPID socket server"
_POLL_S = 0.001
_DONE, _REFUSED = b"\x00\x01", b"\x00\x00"


class FakeRapidServer(ServedController):
    """One fake server.

    Args:
        host, motion, rate, clock: as in `FakeController`.
        port: port of the server.
        faults: faults to inject.

    Attributes:
        speed_percent: the pendant's speed ratio, for subsequent moves; the server does not report
            it.
    """

    def __init__(
        self,
        host: str,
        port: int = 5000,
        rate: float = 1.0,
        faults: Sequence[Fault] = (),
        motion: StraightMotion | None = None,
        clock: ControllerClock | None = None,
    ) -> None:
        super().__init__(host, motion, clock, rate)
        self.port = port
        self._faults = FaultPlan(faults, self._inject)
        self.tool = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        self.speed_percent = 100.0
        self._speed_mm_s = 10.0
        self._zone_mm = 0.0
        self._stopped = self._silent = self._late = False
        self._turn: asyncio.Lock | None = None

    def drop_connections(self) -> None:
        """Close the open connections; new ones are accepted."""
        self._inside(self._connections.cut)
        self._inside(self._listen)

    def restore(self) -> None:
        """Clear every fault of connection and safety, as an operator would."""
        self._inside(self._connections.cut)
        self._stopped = self._silent = self._late = False
        self._inside(self._listen)

    def _listen(self) -> None:
        self._turn = asyncio.Lock()
        self._connections.listen(self.host, self.port, self._serve)

    def _inject(self, kind: Kind) -> None:
        if kind is Kind.LINK_CUT:
            self._connections.cut()
        elif kind is Kind.SILENCE:
            self._silent = True
        elif kind is Kind.LATE_ANSWER:
            self._late = True
        elif kind in {Kind.CLOCK_BACK, Kind.PACKETS_LOST}:
            raise ValueError(f"{kind.value} is not simulated: this server reports no time")
        else:
            self._stopped = True
            self.motion.stop(ACCELERATION_MM_S2, self.clock.now_s())

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert self._turn is not None
        async with self._turn:
            while self.moving() or self._stopped:
                await self._tick()
            held = b""
            while True:
                (number,) = struct.unpack(">H", await reader.readexactly(2))
                if number == ServerCommand.CLOSE:
                    return
                if number not in list(ServerCommand):
                    writer.write(_REFUSED)
                    return
                command = ServerCommand(number)
                layout = struct.Struct(">" + ARGUMENTS[command])
                values = layout.unpack(await reader.readexactly(layout.size))
                self._faults.reach(Stage.CONNECTING)
                reply = await self._do(command, values)
                if self._silent:
                    await asyncio.get_running_loop().create_future()
                if self._late:
                    self._late, held = False, reply
                    continue
                writer.write(held + reply)
                held = b""

    async def _do(self, command: ServerCommand, values: tuple[float, ...]) -> bytes:
        if command is ServerCommand.INFO:
            return _DONE + INFO
        if command is ServerCommand.MOVE_LINEAR and self._speed_mm_s <= 0:
            return _REFUSED
        if command is ServerCommand.MOVE_LINEAR:
            await self._move(from_quaternion(values[:3], values[3:]))
            return _DONE
        if command is ServerCommand.SET_TCP:
            self.tool = from_quaternion(values[:3], values[3:])
        elif command is ServerCommand.SET_SPEED:
            self._speed_mm_s = values[0]
        elif command is ServerCommand.SET_ZONE:
            self._zone_mm = 0.0 if values[0] else values[1]
        elif command is ServerCommand.JOINTS:
            return _DONE + struct.pack(">6f", *JOINTS_DEG)
        elif command is ServerCommand.POSE:
            pose = self.pose()
            return _DONE + struct.pack(">7f", *pose.xyz_mm, *quaternion(pose))
        elif command is not ServerCommand.SET_WORK_OBJECT or values != (0, 0, 0, 1, 0, 0, 0):
            return _REFUSED  # joint moves, circular moves and other frames are not simulated
        return _DONE

    async def _move(self, to: Pose) -> None:
        begin = self.pose()
        now, speed_mm_s = self.clock.now_s(), self._speed_mm_s * self.speed_percent / 100
        if not self.motion.extend(to, speed_mm_s, now):
            self.motion.move(to, speed_mm_s, ACCELERATION_MM_S2, now)
        zone_mm = min(self._zone_mm, distance_mm(begin, to) / 2)  # RAPID's own rule
        while self.moving() or self._stopped:
            here = self.pose()
            self._faults.reach(Stage.MOVING, distance_mm(begin, here))
            if not self._stopped and 0 < distance_mm(here, to) < zone_mm:
                return
            await self._tick()

    async def _tick(self) -> None:
        loop = asyncio.get_running_loop()
        tick = loop.create_future()
        loop.call_later(_POLL_S, _end, tick)
        await tick


def _end(tick: asyncio.Future[None]) -> None:
    if not tick.done():
        tick.set_result(None)
