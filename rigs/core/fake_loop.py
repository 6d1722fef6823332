"""An asyncio server in a thread of its own, started and ended within a bound."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")
Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]
START_S = 5.0
"""How long a stand-in may take to open its ports, or to close them, s."""


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
