"""A service outlives its Prefect server: what runs goes on, and its end is reported afterwards.

Prefect's runner gives up after three requests without an answer, and what it runs ends with it.
Here it goes on asking; a server of our own that ended, or does not answer, is started anew at its
port; and once a server answers again it is told what ended meanwhile.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from sliplab.flows.running import console, run_records
from sliplab.flows.running.embedded_server import EmbeddedServer, ServerError

WATCH_S = 5.0
"""How often the server is asked whether it is well, and how long its answer is waited for."""
MISSES = 3
"""So many times without an answer, and the server is lost."""


class PageServer:
    """A server of our own with its page, which can be started anew at the same port.

    Raises:
        ServerError: the port is taken.
    """

    def __init__(self, home: Path, port: int, password: str) -> None:
        self._make = partial(EmbeddedServer, home, page=True, password=password)
        self.server = self._make(port)

    async def renew(self) -> None:
        """End the server and start another one, in this thread: the kernel ends it with that."""
        await asyncio.to_thread(self.server.stop)
        try:
            self.server = self._make(self.server.port)
        except ServerError as error:  # the port may be free the next time
            console.say(f"warning: {error}")


async def watch(page: PageServer | None, store: Path, server: str, stopped: asyncio.Event) -> None:
    """Look after the service's server until `stopped`.

    Args:
        page: our own server; None for the user's.
        server: as `run_records.server_name` calls it.
    """
    misses, lost = 0, False
    while not stopped.is_set():
        with suppress(TimeoutError):
            await asyncio.wait_for(stopped.wait(), WATCH_S)
            return
        if await _answers():
            if lost:
                console.say("Prefect's server answers again")
                with suppress(Exception):  # the next start does it again
                    await asyncio.to_thread(run_records.close_dead, store, server)
            misses, lost = 0, False
            continue
        misses += 1
        ended = page is not None and not page.server.alive
        if not lost and (ended or misses == MISSES):
            lost = True
            console.say(
                f"warning: Prefect's server {'ended' if ended else 'does not answer'}; what runs "
                "goes on, and its end is reported when the server answers again"
            )
        if page is not None and (ended or misses % MISSES == 0):
            await page.renew()


async def _answers() -> bool:
    from prefect.client.orchestration import get_client

    try:
        async with asyncio.timeout(WATCH_S), get_client() as client:
            return await client.api_healthcheck() is None
    except Exception:
        return False


def ask_on() -> None:
    """Have Prefect's runner and its runs ask on while their server does not answer.

    Its second way to learn of a cancelled run, used once its connection for events was
    lost, is refused by the server (422). That is no reason to print a traceback: `stop/NAME` acts.
    """
    from httpx import HTTPStatusError, TransportError
    from prefect._internal import observers
    from prefect.runner import _scheduled_run_poller
    from prefect.utilities.services import critical_service_loop

    def patient(least: int) -> Any:
        """Prefect's loop, which goes on after an answer of status `least` or more, or none."""

        async def loop(workload: Callable[[], Awaitable[Any]], **options: Any) -> None:
            async def once() -> None:
                with suppress(TransportError):
                    try:
                        await workload()
                    except HTTPStatusError as error:
                        if error.response.status_code < least:
                            raise

            await critical_service_loop(once, **options)

        return loop

    async def cancelled(workload: Callable[[], Awaitable[Any]], **options: Any) -> None:
        with suppress(asyncio.CancelledError):  # the end of the service; whoever asks takes no such
            await patient(400)(workload, **options)

    poller: Any = _scheduled_run_poller
    observer: Any = observers
    poller.critical_service_loop = patient(500)
    observer.critical_service_loop = cancelled
