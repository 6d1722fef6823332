"""The Prefect server of a service: its page, its password, and the handling of its loss.

A service outlives its server. A server of our own that ended, or does not answer, is restarted
at its port; once a server answers again, the runs that ended in the meantime are reported to it.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import ProxyHandler, build_opener

from sliplab.flows.running import console, run_records
from sliplab.flows.running.embedded_server import (
    EmbeddedServer,
    ServerError,
    WebFront,
    new_password,
)
from sliplab.flows.running.private_file import stored_secret
from sliplab.protocols import InputError

PASSWORD = "page-password"
"""The file in Prefect's home that has the password of the service's own page."""
_PASSWORD = r"[!-~]{30,200}"
ANSWER_S = 10.0
"""Timeout of the check that a server asks for a password, s."""
WATCH_S = 5.0
"""Interval and timeout of the server's health check, s."""
MISSES = 3
"""Failed health checks in a row after which the server counts as lost."""


class PageServer:
    """A server of our own with its page, which can be restarted at the same port.

    Args:
        front: the web application that has the same port.

    Raises:
        ServerError: the port is taken.
    """

    def __init__(self, home: Path, port: int, password: str, front: WebFront) -> None:
        self._make = partial(EmbeddedServer, home, page=True, password=password, front=front)
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
    from prefect.client.orchestration import get_client

    misses, lost = 0, False
    # one client: each has a copy of the certificates, which only the garbage collector frees
    async with get_client() as client:
        while not stopped.is_set():
            with suppress(TimeoutError):
                await asyncio.wait_for(stopped.wait(), WATCH_S)
                return
            if await _answers(client):
                if lost:
                    console.say("Prefect's server responds again")
                    with suppress(Exception):  # the next start does it again
                        await asyncio.to_thread(run_records.close_killed_runs, store, server)
                misses, lost = 0, False
                continue
            misses += 1
            ended = page is not None and not page.server.alive
            if not lost and (ended or misses == MISSES):
                lost = True
                console.say(
                    f"warning: Prefect's server {'ended' if ended else 'does not answer'}; what "
                    "runs continues, and its end is reported when the server answers again"
                )
            if page is not None and (ended or misses % MISSES == 0):
                await page.renew()


async def _answers(client: Any) -> bool:
    try:
        async with asyncio.timeout(WATCH_S):
            return await client.api_healthcheck() is None
    except Exception:
        return False


@contextmanager
def page_server(port: int, front: WebFront) -> Iterator[tuple[str, PageServer | None]]:
    """The address of Prefect's API while the block runs: PREFECT_API_URL, or a server of ours.

    Ours asks for a password, which the processes of the runs find in their environment and people
    in a file of Prefect's home that only this user can read.

    Raises:
        ServerError: ours did not start; its port may be taken.
        InputError: the password cannot be stored where only this user can read it, or the server
            at PREFECT_API_URL requires none.
    """
    from prefect.settings import PREFECT_API_URL, temporary_settings

    url = PREFECT_API_URL.value()
    if url is not None:
        refuse_open(url)
        yield url, None
        return
    home = Path(os.environ["PREFECT_HOME"])
    page = PageServer(home, port, page_password(home), front)
    before = dict(os.environ)
    try:
        settings = page.server.settings()
        os.environ.update({setting.name: value for setting, value in settings.items()})
        with temporary_settings(updates=settings):
            console.say(
                f"the password of Prefect's page is in {home / PASSWORD}, readable only by you"
            )
            yield page.server.url, page
    finally:
        for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
            os.environ.pop(name, None)
            os.environ.update({name: before[name]} if name in before else {})
        page.server.stop()


def refuse_open(url: str) -> None:
    """Check that a Prefect server requires a password; if none listens, Prefect reports that.

    Raises:
        InputError: it does not, and anyone who reaches it can move the arm; or it does not answer
            in time, so that this is unknown.
    """
    address = run_records.server_name(url)
    try:
        # a proxy of the environment would refuse the loopback, as if it were a password
        opener = build_opener(ProxyHandler({}))
        with opener.open(f"{address}{urlsplit(url).path}/admin/version", timeout=ANSWER_S):
            pass
    except OSError as error:  # 401 is one, too
        if not isinstance(getattr(error, "reason", error), TimeoutError):
            return
        raise InputError(
            "PREFECT_API_URL",
            "",
            address,
            f"did not answer in {ANSWER_S:g} s, so whether it asks for a password is not known; "
            "try again",
        ) from None
    raise InputError(
        "PREFECT_API_URL",
        "",
        address,
        "has no password, so any web page in a browser that reaches it could move the arm; "
        "set PREFECT_SERVER_API_AUTH_STRING for the server and PREFECT_API_AUTH_STRING here",
    )


def page_password(home: Path) -> str:
    """The password of a service's page, stored from one start to the next.

    Raises:
        InputError: it cannot be stored where only this user can read it.
    """
    return stored_secret(home / PASSWORD, _PASSWORD, new_password)
