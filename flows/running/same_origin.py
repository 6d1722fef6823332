"""The check in front of a server on the loopback: it answers its own pages and plain clients only.

Every web page that is open in a browser on this computer can send requests to the loopback. Its
scripts cannot change two headers: `Origin` names the page, and `Host` the name under which the page
found the server. A name that is not this computer's own belongs to a page that has pointed its name
here (DNS rebinding) and that the browser takes for the server's own.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_NAMES = ("127.0.0.1", "localhost", "[::1]")
_HTTP_PORT = 80
"""The port that a browser leaves out of `Host` and `Origin`."""


def own_hosts(port: int) -> frozenset[str]:
    """The values of `Host` of a server on this computer's loopback."""
    hosts = {f"{name}:{port}" for name in _NAMES}
    return frozenset(hosts | set(_NAMES) if port == _HTTP_PORT else hosts)


class SameOrigin:
    """An ASGI application that refuses foreign hosts (421) and foreign origins (403).

    It covers every method, path and websocket before `app` sees them, and no page may frame it.

    Args:
        port: the one that the server listens on.
    """

    def __init__(self, app: ASGIApp, port: int) -> None:
        self._app = app
        self._hosts = own_hosts(port)
        self._origins = frozenset(f"http://{host}" for host in self._hosts)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        status, text = self._refusal(scope)
        if not status:
            await self._app(scope, receive, _unframed(send))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": text})
        else:
            kind = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": status, "headers": kind})
            await send({"type": "http.response.body", "body": text.encode()})

    def _refusal(self, scope: Scope) -> tuple[int, str]:
        """Status and text for a request that is refused; 0 for one that is not."""
        hosts = _values(scope, b"host")
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return 421, "this server is reached by its own address only\n"
        if any(origin not in self._origins for origin in _values(scope, b"origin")):
            return 403, "this server answers no other page\n"
        return 0, ""


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key == name]


def _unframed(send: Send) -> Send:
    """`send` with the header that keeps a page out of every other page's frames."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), (b"x-frame-options", b"DENY")]
        await send(message)

    return sending
