"""An asyncio server in a thread of its own, started and ended within a bound."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any, TypeVar

T = TypeVar("T")
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
        tasks = asyncio.all_tasks(self._loop)
        for task in tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
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


class Connections:
    """TCP servers and their live connections, so that a link can be cut at one go."""

    def __init__(self) -> None:
        self._servers: list[asyncio.Server] = []
        self._live: dict[asyncio.StreamWriter, asyncio.Task[None]] = {}

    async def listen(
        self,
        host: str,
        port: int,
        talk: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]],
    ) -> None:
        """Take connections on a port; `talk` speaks with one and may end by a lost connection."""

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            task = asyncio.current_task()
            assert task is not None
            self._live[writer] = task
            try:
                await talk(reader, writer)
            except (OSError, asyncio.IncompleteReadError, asyncio.CancelledError):
                pass  # the client left, or the link was cut
            finally:
                del self._live[writer]
                writer.close()

        self._servers.append(await asyncio.start_server(serve, host, port))

    def cut(self) -> None:
        """Close every connection and take no new one."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        for writer, task in list(self._live.items()):
            writer.transport.abort()
            task.cancel()
