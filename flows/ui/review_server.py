"""Serve the review page on this computer only, until it is stopped.

Anyone who reaches the page can decide. So it listens on the loopback address, has a path that
cannot be guessed, is listed nowhere, and answers neither another page's scripts nor a foreign host
name (`flows.running.same_origin`, for pages and for the connection that carries everything).
"""

from __future__ import annotations

import asyncio
import secrets
import socket
from collections.abc import Awaitable, Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.auth_provider import AuthProvider
from bokeh.server.server import Server
from tornado.ioloop import IOLoop
from tornado.web import HTTPError

from sliplab.flows.running.same_origin import own_hosts, refusal
from sliplab.flows.ui.review import TrialList
from sliplab.flows.ui.review_tab import ReviewTab
from sliplab.protocols.errors import InputError
from sliplab.storage.process import user_name
from sliplab.storage.trials.store import Store

HOST = "127.0.0.1"
_KEEP_MS = 60_000
"""A tab that was closed is forgotten after this long."""


@contextmanager
def serving(
    store: Store, campaigns: Sequence[str] = (), port: int = 0, who: str = ""
) -> Iterator[tuple[str, TrialList]]:
    """Serve the page in this thread's event loop while the block runs.

    Args:
        port: 0 takes a free one.

    Yields:
        the page's address, and the list of trials.

    Raises:
        InputError: the port is taken, or a campaign is unknown.
        StoreError: a campaign is damaged.
    """
    trials = TrialList(store, campaigns)
    with ThreadPoolExecutor(1, thread_name_prefix="review") as pool:

        def make(doc: Document) -> None:
            ReviewTab(doc, trials, pool, who or user_name())

        path = f"/{secrets.token_urlsafe(24)}"
        server = _server(path, make, port)
        try:
            server.start()
            yield f"http://{HOST}:{server.port}{path}", trials
        finally:
            server.stop(wait=True)
            server.unlisten()


class _OwnPage(AuthProvider):
    """Checks every page and connection before Bokeh answers; who knows the path may come in.

    Attributes:
        port: that the server listens on.
    """

    port = 0

    @property
    def get_user_async(self) -> Callable[[Any], Awaitable[str]]:
        """The check of one request; it raises the HTTP error to answer with."""
        return self._check

    async def _check(self, handler: Any) -> str:
        headers = handler.request.headers
        found = headers.get_list("Host"), headers.get_list("Origin")
        status, text = refusal(*found, own_hosts(self.port))
        if status:
            raise HTTPError(status, reason=text.strip())
        return "here"

    @property
    def login_url(self) -> str:
        """A login URL, which Bokeh requires; there is no login."""
        return "/"


def _server(path: str, make: Callable[[Document], None], port: int) -> Server:
    application = Application(FunctionHandler(make, trap_exceptions=True))
    own = _OwnPage()
    try:
        # looked at before: the server does not close a socket that it could not bind
        with socket.socket() as trial:
            trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            trial.bind((HOST, port))
        server = Server(
            {path: application},
            io_loop=IOLoop.current(),
            address=HOST,
            port=port,
            # Bokeh puts the port that was taken in place of 0
            allow_websocket_origin=[f"{HOST}:{port}"],
            auth_provider=own,
            use_index=False,
            redirect_root=False,
            generate_session_ids=True,
            unused_session_lifetime_milliseconds=_KEEP_MS,
            check_unused_sessions_milliseconds=_KEEP_MS // 4,
        )
    except OSError as error:
        raise InputError("--port", "", port, f"cannot be listened on: {error.strerror}") from None
    own.port = server.port
    return server


def serve(
    store: Store,
    campaigns: Sequence[str],
    port: int,
    who: str,
    ready: Callable[[str, TrialList], None],
) -> None:
    """Serve until the program is interrupted.

    Args:
        ready: called with the page's address and the trials once it can be opened.

    Raises:
        KeyboardInterrupt: how it ends.
    """
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    try:
        with serving(store, campaigns, port, who) as (address, trials):
            ready(address, trials)
            loop.run_forever()
    finally:
        asyncio.set_event_loop(None)
        loop.close()
