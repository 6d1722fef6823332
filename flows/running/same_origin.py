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
_KINDS = ("http", "ws")
_HTTP_PORT = 80
"""The port that a browser leaves out of `Host` and `Origin`."""


def own_hosts(port: int) -> frozenset[str]:
    """The values of `Host` of a server on this computer's loopback."""
    hosts = {f"{name}:{port}" for name in _NAMES}
    return frozenset(hosts | set(_NAMES) if port == _HTTP_PORT else hosts)


def refusal(
    hosts: list[str], origins: list[str], own: frozenset[str], public: str = ""
) -> tuple[int, str]:
    """Status and text for a request that is refused; status 0 for one that is not.

    Args:
        hosts: the values of its `Host`; origins: those of its `Origin`.
        own: the server's `own_hosts`.
        public: origin of a reverse proxy, such as ``https://lab.example``, that passes `Host` and
            `Origin` on; empty without one.
    """
    through_proxy = bool(public) and hosts == [public.partition("://")[2]]
    if not through_proxy and (len(hosts) != 1 or hosts[0].lower() not in own):
        return 421, "this server accepts requests to its own address only\n"
    known = {public} if through_proxy else {f"http://{host}" for host in own}
    if any(origin not in known for origin in origins):
        return 403, "this server accepts no requests from other pages\n"
    return 0, ""


class SameOrigin:
    """An ASGI application that refuses foreign hosts (421) and foreign origins (403).

    It covers every method, path and websocket before `app` sees them. No page may frame its pages,
    and their scripts reach this server only: Prefect's would report to others.

    Args:
        port: the one that the server listens on.
        public: as of `refusal`.
    """

    def __init__(self, app: ASGIApp, port: int, public: str = "") -> None:
        self._app, self._public = app, public
        self._hosts = own_hosts(port)
        reached = " ".join(
            f"{kind}://{host}" for host in sorted(self._hosts) for kind in _KINDS if "[" not in host
        )
        policy = f"connect-src 'self' {reached}; frame-ancestors 'none'"
        self._headers = [
            (b"content-security-policy", policy.encode()),
            (b"x-frame-options", b"DENY"),
        ]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in {"http", "websocket"}:
            await self._app(scope, receive, send)
            return
        hosts, origins = _values(scope, b"host"), _values(scope, b"origin")
        status, text = refusal(hosts, origins, self._hosts, self._public)
        if not status:
            await self._app(scope, receive, _with(send, self._headers))
        elif scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": text})
        else:
            kind = [(b"content-type", b"text/plain; charset=utf-8")]
            await send({"type": "http.response.start", "status": status, "headers": kind})
            await send({"type": "http.response.body", "body": text.encode()})


def _values(scope: Scope, name: bytes) -> list[str]:
    return [value.decode("latin-1") for key, value in scope["headers"] if key == name]


def _with(send: Send, headers: list[tuple[bytes, bytes]]) -> Send:
    """`send`, with headers added to every answer."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", ()), *headers]
        await send(message)

    return sending
