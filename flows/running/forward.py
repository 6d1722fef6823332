"""Forwards requests to the program that has the web application, over a socket of the file system.

The application is a program of its own, so that nothing in it can take Prefect's server along; one
port, behind one gate, has both.
"""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse, Response, StreamingResponse

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Receive, Scope, Send

PREFECT = ("/api", "/v2", "/ui-settings")
"""First parts of the paths that Prefect's server answers."""
ANSWER_S = 60.0
"""Longest silence of an answer, s; a stream of events is silent for 15 s at most."""
LARGEST_BODY = 2_000_000
"""Bytes of a forwarded request."""
_HOP = frozenset(
    {b"connection", b"keep-alive", b"transfer-encoding", b"upgrade", b"te", b"trailer"}
)
"""Headers of one connection."""


class Forward:
    """An ASGI application: Prefect's server, and for all other paths another program.

    Args:
        prefect: Prefect's application; it gets websockets and the lifespan, too.
        socket: on which the other program listens; it may come and go.
    """

    def __init__(self, prefect: ASGIApp, socket: Path) -> None:
        self._prefect = prefect
        # no client: it would keep one browser's cookies and send them for the next
        self._line = httpx.AsyncHTTPTransport(uds=str(socket))

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request; with the server's life end the connections to the other program."""
        if scope["type"] == "lifespan":
            try:
                await self._prefect(scope, receive, send)
            finally:
                await self._line.aclose()
            return
        path = f"{scope.get('path', '')}/"
        if scope["type"] != "http" or path.startswith(tuple(f"{part}/" for part in PREFECT)):
            await self._prefect(scope, receive, send)
            return
        try:
            answer = await self._ask(Request(scope, receive))
        except (httpx.HTTPError, ClientDisconnect):
            again = {"refresh": "2"} if scope["method"] == "GET" else {}
            answer = PlainTextResponse("the page is starting; load it again\n", 503, again)
        await answer(scope, receive, send)

    async def _ask(self, request: Request) -> Response:
        body = b""
        async for part in request.stream():
            body += part
            if len(body) > LARGEST_BODY:
                return PlainTextResponse(f"more than {LARGEST_BODY} bytes\n", 413)
        query = request.url.query.encode()
        url = httpx.URL("http://web").copy_with(path=request.url.path, query=query or None)
        headers = [pair for pair in request.headers.raw if pair[0] not in _HOP]
        limits = {"timeout": httpx.Timeout(ANSWER_S, connect=2.0).as_dict()}
        asked = httpx.Request(request.method, url, headers=headers, content=body, extensions=limits)
        got = await self._line.handle_async_request(asked)
        answer = StreamingResponse(_parts(got), got.status_code)
        answer.raw_headers = [
            (key.lower(), value) for key, value in got.headers.raw if key.lower() not in _HOP
        ]
        return answer


async def _parts(answer: httpx.Response) -> AsyncIterator[bytes]:
    """Return an answer's body as it comes; it ends early where the other program ends."""
    try:
        async for part in answer.aiter_raw():
            yield part
    except httpx.HTTPError:
        return
    finally:
        await answer.aclose()
