"""Access to the web application: two links, a cookie, and a token in every form.

A link holds a random token, which a file that only this user can read keeps: the operator's link
may do everything, the reader's link changes nothing. A browser exchanges the token once for a
cookie, so that it does not stay in the address bar; the cookie is signed with the token, and a new
token ends all cookies. Every request that may change something needs the operator's cookie and a
token of that cookie, which no other site can read.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from http.cookies import CookieError, SimpleCookie
from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, quote, unquote

from starlette.responses import PlainTextResponse

from sliplab.plugins.web.server.links import ROLES, Role

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

COOKIE, NAME_COOKIE = "sliplab", "sliplab-name"
"""The first is followed by the server's port: browsers send cookies to all ports of a host."""
CSRF_FIELD, CSRF_HEADER = "csrf", "x-csrf-token"
DAYS = 60
"""Life of a cookie."""
LARGEST_BODY = 1_000_000
"""Bytes of a request's body."""
OPEN = ("/enter", "/static/")
"""Paths that need no cookie."""
_SAFE = frozenset({"GET", "HEAD", "OPTIONS"})
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
)


@dataclass(frozen=True)
class Viewer:
    """Who asks.

    Attributes:
        name: as the person gave it; empty before.
        csrf: the token that forms must send back.
    """

    role: Role
    name: str
    csrf: str

    @property
    def operates(self) -> bool:
        """Return whether this viewer may change something."""
        return self.role == "operator"


@dataclass(frozen=True)
class Access:
    """The tokens of the two links."""

    tokens: Mapping[Role, str]

    @staticmethod
    def temporary() -> Access:
        """Return new tokens, for a page that nobody opens once its program has ended."""
        return Access({role: secrets.token_urlsafe(32) for role in ROLES})

    def role_of(self, token: str) -> Role | None:
        """Return the role that this token gives, or None."""
        for role in ROLES:
            if hmac.compare_digest(self.tokens[role].encode(), token.encode()):
                return role
        return None

    def cookie(self, role: Role) -> str:
        """Return the value of a new cookie."""
        nonce = secrets.token_urlsafe(16)
        return f"{role}.{nonce}.{self._signed(role, f'cookie {nonce}')}"

    def viewer(self, cookies: Mapping[str, str], host: str = "") -> Viewer | None:
        """Return who has these cookies of a host; None without a valid one."""
        role, _, rest = cookies.get(cookie_name(host), "").partition(".")
        nonce, _, signature = rest.partition(".")
        for known in ROLES:
            right = self._signed(known, f"cookie {nonce}")
            if role == known and hmac.compare_digest(right.encode(), signature.encode()):
                name = unquote(cookies.get(NAME_COOKIE, ""))[:100].strip()
                return Viewer(known, name, self._signed(known, f"form {nonce}"))
        return None

    def _signed(self, role: Role, text: str) -> str:
        return hmac.new(self.tokens[role].encode(), text.encode(), hashlib.sha256).hexdigest()


def cookie_name(host: str) -> str:
    """Return the name of the cookie of a server, given the value of `Host`."""
    port = host.rpartition(":")[2]
    return f"{COOKIE}-{port}" if port.isdecimal() else COOKIE


def set_cookie(name: str, value: str, *, secure: bool) -> tuple[str, str]:
    """Return the header that stores a cookie which scripts and other sites do not get."""
    flags = "; Secure" if secure else ""
    kept = f"Path=/; Max-Age={DAYS * 86400}; HttpOnly; SameSite=Strict{flags}"
    return "set-cookie", f"{name}={quote(value)}; {kept}"


class AccessGate:
    """An ASGI application that lets only known viewers reach `app`, and only operators change it.

    Without a cookie it answers 401 with the page `entry`; a reader's change, a change without the
    form's token and every websocket 403; a body of more than `LARGEST_BODY` 413.
    """

    def __init__(self, app: ASGIApp, access: Access, entry: str) -> None:
        self._app, self._access, self._entry = app, access, entry.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008, "reason": "no websockets here"})
            return
        headers = {
            key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]
        }
        send = _with_policy(send)
        if scope["path"].startswith(OPEN):
            await self._app(scope, receive, send)
            return
        cookies = _cookies(headers.get("cookie", ""))
        viewer = self._access.viewer(cookies, headers.get("host", ""))
        if viewer is None:
            answer = PlainTextResponse(self._entry, 401, media_type="text/html")
            await answer(scope, receive, send)
            return
        scope.setdefault("state", {})["viewer"] = viewer
        if scope["method"] not in _SAFE:
            body = await _body(receive)
            refused = _refusal(viewer, headers, body)
            if refused is not None:
                await refused(scope, receive, send)
                return
            receive = _again(body or b"", receive)
        await self._app(scope, receive, send)


def _refusal(
    viewer: Viewer, headers: Mapping[str, str], body: bytes | None
) -> PlainTextResponse | None:
    if not viewer.operates:
        return PlainTextResponse("this link only reads\n", 403)
    if body is None:
        return PlainTextResponse(f"more than {LARGEST_BODY} bytes\n", 413)
    token = headers.get(CSRF_HEADER) or dict(parse_qsl(body.decode("latin-1"))).get(CSRF_FIELD, "")
    if not hmac.compare_digest(token.encode(), viewer.csrf.encode()):
        return PlainTextResponse("the form is too old: load the page again\n", 403)
    return None


def _cookies(header: str) -> dict[str, str]:
    try:
        return {name: morsel.value for name, morsel in SimpleCookie(header).items()}
    except CookieError:
        return {}


async def _body(receive: Receive) -> bytes | None:
    """Return a request's body; None if it is too large."""
    body, more = b"", True
    while more and len(body) <= LARGEST_BODY:
        message = await receive()
        body += message.get("body", b"")
        more = message.get("more_body", False)
    return body if len(body) <= LARGEST_BODY else None


def _again(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that begins with a body that was read before."""
    first = [body]

    async def receiving() -> Message:
        if first:
            return {"type": "http.request", "body": first.pop(), "more_body": False}
        return await receive()

    return receiving


def _with_policy(send: Send) -> Send:
    """Return `send` with a policy for answers that have none, which keeps other sites out."""

    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = list(message.get("headers", ()))
            names = {name for name, _ in headers}
            if b"content-security-policy" not in names:
                headers.append((b"content-security-policy", POLICY.encode()))
            if b"cache-control" not in names:
                headers.append((b"cache-control", b"no-store"))
            headers += [
                (b"x-content-type-options", b"nosniff"),
                (b"referrer-policy", b"same-origin"),
            ]
            message["headers"] = headers
        await send(message)

    return sending
