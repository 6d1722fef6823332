"""The checks of a service's Prefect server: days of them leave nothing behind."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager
from pathlib import Path

import pytest

from sliplab.plugins.web.server import page_server
from tests.plugins.web.server.serving import clients, no_garbage_collection

ANSWER = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 4\r\n\r\ntrue"


class HealthyServer:
    """A server that says that it is well, over connections that stay open.

    Attributes:
        checks: those that it answered.
    """

    def __init__(self) -> None:
        self.checks = 0
        self.port = 0
        self._lines: set[asyncio.StreamWriter] = set()

    @asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Serve while the block runs, at the same port each time."""
        server = await asyncio.start_server(self._answer, "127.0.0.1", self.port)
        self.port = server.sockets[0].getsockname()[1]
        try:
            yield
        finally:
            server.close()
            for line in list(self._lines):
                line.close()
            await server.wait_closed()

    async def _answer(self, reader: asyncio.StreamReader, line: asyncio.StreamWriter) -> None:
        self._lines.add(line)
        try:
            while await reader.readuntil(b"\r\n\r\n"):
                line.write(ANSWER)
                await line.drain()
                self.checks += 1
        except (asyncio.IncompleteReadError, ConnectionError):
            pass  # the client, or `running`, closed it
        finally:
            self._lines.discard(line)
            line.close()

    async def answered(self, count: int) -> None:
        """Wait for so many further checks."""
        last = self.checks + count
        while self.checks < last:
            await asyncio.sleep(0.01)


@asynccontextmanager
async def watched(server: HealthyServer, store: Path) -> AsyncIterator[None]:
    """The checks run while the block does."""
    from prefect.settings import (
        PREFECT_API_URL,
        PREFECT_CLIENT_MAX_RETRIES,
        temporary_settings,
    )

    stopped = asyncio.Event()
    url = f"http://127.0.0.1:{server.port}/api"
    with temporary_settings(updates={PREFECT_API_URL: url, PREFECT_CLIENT_MAX_RETRIES: 0}):
        checks = asyncio.create_task(page_server.watch(None, store, "here", stopped))
    try:
        yield
    finally:
        stopped.set()
        await checks


@pytest.fixture(autouse=True)
def short_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twenty checks take a second."""
    monkeypatch.setattr(page_server, "WATCH_S", 0.05)


def test_checks_leave_no_clients_for_the_garbage_collector(tmp_path: Path) -> None:
    async def run() -> None:
        server = HealthyServer()
        async with asyncio.timeout(60), server.running(), watched(server, tmp_path):
            await server.answered(2)
            before = clients()
            await server.answered(20)
            assert clients() == before

    with no_garbage_collection():
        asyncio.run(run())


def test_a_server_that_comes_back_is_found_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    monkeypatch.setattr(page_server.console, "say", said.append)

    async def until_said(words: str) -> None:
        while not any(words in line for line in said):
            await asyncio.sleep(0.01)

    async def run() -> None:
        server = HealthyServer()
        async with asyncio.timeout(60), AsyncExitStack() as stack:
            async with server.running():
                await stack.enter_async_context(watched(server, tmp_path))
                await server.answered(2)
            await until_said("does not answer")
            async with server.running():
                await until_said("responds again")

    asyncio.run(run())
