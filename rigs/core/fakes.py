"""The common part of fake controllers: an asyncio server in its own thread, and faults by name.

A fake speaks the own protocol of a device, so that the real driver can be tried without it. None of
them copies what a device costs in time; what they copy is what it says, and how it fails.
"""

from __future__ import annotations

import asyncio
import math
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Self, TypeVar

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import ControllerClock, StraightMotion, running_clock

T = TypeVar("T")
Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
START_S = 5.0
"""Time limit for a fake to open its ports, or to close them, s."""
HOME = Pose((400.0, 0.0, 300.0), (180.0, 0.0, 0.0))
"""First position of a fake's tool centre point."""


class LoopThread:
    """Runs coroutines in the background; `call` reaches into it from any other thread."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_forever()
        self._loop.run_until_complete(_one_turn())  # a task that never began could not clean up
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
        self._loop.run_until_complete(_one_turn())  # sockets close in the turn after
        self._loop.close()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """The result of `work`. Raises TimeoutError after `START_S`."""
        return asyncio.run_coroutine_threadsafe(work, self._loop).result(START_S)

    def call(self, function: Callable[[], T]) -> T:
        """The result of a plain function, run between two of the loop's own steps."""

        async def work() -> T:
            return function()

        return self.run(work())

    def close(self) -> None:
        """End every coroutine; safe to call more than once."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(START_S)


async def _one_turn() -> None:
    """Let everything run that is ready to."""
    loop = asyncio.get_running_loop()
    turn = loop.create_future()
    loop.call_soon(turn.set_result, None)
    await turn


class Connections:
    """TCP ports and their live connections, so that a link can be cut at one go.

    asyncio's own server loses a connection that is being taken while it is closed (Python 3.11), so
    connections are taken here.
    """

    def __init__(self) -> None:
        self._doors: list[socket.socket] = []
        self._talks: dict[asyncio.Task[None], socket.socket] = {}
        self._waiting: set[socket.socket] = set()

    def listen(self, host: str, port: int, talk: Talk) -> None:
        """Take connections on a port; `talk` speaks with one and may end by a lost connection.

        Raises:
            OSError: the port is taken.
        """
        door = socket.create_server((host, port), backlog=16)
        door.setblocking(False)
        self._doors.append(door)
        asyncio.get_running_loop().add_reader(door, self._take, door, talk)

    def cut(self) -> None:
        """Close every connection and take no new one."""
        for door in self._doors:
            asyncio.get_running_loop().remove_reader(door)
            door.close()
        self._doors.clear()
        for task in list(self._talks):
            task.cancel()

    def _take(self, door: socket.socket, talk: Talk) -> None:
        try:
            link, _ = door.accept()
        except OSError:
            return  # it has left already
        link.setblocking(False)
        task = asyncio.get_running_loop().create_task(self._serve(link, talk))
        self._talks[task] = link
        self._waiting.add(link)
        task.add_done_callback(self._forget)

    async def _serve(self, link: socket.socket, talk: Talk) -> None:
        self._waiting.discard(link)
        reader, writer = await asyncio.open_connection(sock=link)
        try:
            await talk(reader, writer)
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client left
        except asyncio.CancelledError:
            writer.transport.abort()  # the link was cut
        finally:
            writer.close()

    def _forget(self, task: asyncio.Task[None]) -> None:
        link = self._talks.pop(task)
        if link in self._waiting:  # cut before it began
            self._waiting.discard(link)
            link.close()


CLOCK_BACK_S = 5.0
PACKETS_LOST = 25


class Kind(Enum):
    """A kind of fault."""

    PROTECTIVE_STOP = "protective stop"
    EMERGENCY_STOP = "emergency stop"
    LINK_CUT = "link cut"
    """Every connection is closed and no new one is taken."""
    SILENCE = "silence"
    """Connections stay open and are taken, and nothing is ever answered or sent again."""
    REMOTE_OFF = "remote control off"
    PROGRAM_END = "program end"
    """Somebody presses stop at the pendant."""
    PROGRAM_PAUSED = "program paused"
    """Somebody presses pause at the pendant."""
    SAFEGUARD_STOP = "safeguard stop"
    """A light curtain or a door stops the arm; a program that runs is paused."""
    POWER_OFF = "power off"
    """Somebody switches the arm off, not its controller."""
    CLOCK_BACK = "clock back"
    """The controller's clock falls back by `CLOCK_BACK_S`."""
    PACKETS_LOST = "packets lost"
    """The next `PACKETS_LOST` packets of poses are not sent."""


class Stage(Enum):
    """The stage at which a fault happens."""

    CONNECTING = "connecting"
    """With the first request of any client."""
    CONTROL = "control"
    """When a client asks to write registers, which is how one takes control."""
    UPLOADING = "uploading"
    """With the first byte of a control script or motion program."""
    MOVING = "moving"
    """Once the tool centre point has travelled `after_mm` in one move."""
    IDLE = "idle"
    """At once, if ready and not moving."""


@dataclass(frozen=True)
class Fault:
    """One thing that goes wrong, once."""

    kind: Kind
    stage: Stage
    after_mm: float = 0.0


class FaultPlan:
    """The faults of one fake that are yet to come, each at its stage.

    Args:
        happen: makes a kind of fault happen now.
    """

    def __init__(self, faults: Sequence[Fault], happen: Callable[[Kind], None]) -> None:
        self._waiting, self._happen = list(faults), happen

    def __bool__(self) -> bool:
        return bool(self._waiting)

    def add(self, fault: Fault) -> None:
        """Wait for one more."""
        self._waiting.append(fault)

    def reach(self, stage: Stage, gone_mm: float = math.inf) -> None:
        """Let happen what waits for a stage that was reached.

        Args:
            gone_mm: how far the tool centre point has travelled in this move.
        """
        for fault in [f for f in self._waiting if f.stage is stage and gone_mm >= f.after_mm]:
            self._waiting.remove(fault)
            self._happen(fault.kind)


class FakeController(ABC):
    """A base for fakes of arm controllers: `start` opens the ports, `close` gives them back.

    Args:
        host: loopback address of its own.
        motion: where the tool centre point is; a straight-line motion from `HOME` if left out.
        clock: the controller's; one of its own, at `rate`, if left out.
        rate: controller seconds a host second.
    """

    def __init__(
        self,
        host: str,
        motion: StraightMotion | None = None,
        clock: ControllerClock | None = None,
        rate: float = 1.0,
    ) -> None:
        self.host = host
        self.motion = motion or StraightMotion(HOME)
        self.clock = clock or running_clock(rate)

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    @abstractmethod
    def start(self) -> None:
        """Open the ports and run. Raises OSError if one of them is taken."""

    @abstractmethod
    def close(self) -> None:
        """Cut every connection and give the ports back."""

    @abstractmethod
    def happen(self, kind: Kind) -> None:
        """Make something go wrong now."""

    @abstractmethod
    def restore(self) -> None:
        """Put everything right, as a person would."""

    def pose(self) -> Pose:
        """Return where the tool centre point is now."""
        return self.motion.pose(self.clock.now_s())

    def moving(self) -> bool:
        """Return whether it is on its way now."""
        return self.motion.moving(self.clock.now_s())
