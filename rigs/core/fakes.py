"""What fakes of controllers share: an asyncio server in a thread of its own, and faults by name.

A fake speaks the own protocol of a device, so that the real driver can be tried without it. None of
them copies what a device costs in time; what they copy is what it says, and how it fails.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeVar

T = TypeVar("T")
Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
START_S = 5.0
"""How long a fake may take to open its ports, or to close them, s."""


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
    """What happens."""

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
    """When it happens."""

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
