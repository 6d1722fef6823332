"""The HTTP of Robot Web Services, version 1: digest authentication, sessions, keep-alive, JSON."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
import secrets
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, unquote, urlsplit

USER, PASSWORD = "Default User", "robotics"
REALM = "validusers@robapi.abb"
_END_S = 5.0
_COOKIE = "ABBCX"
MOST_SESSIONS = 70
"""Largest number of logged-in clients; a further one gets 503, as on the controller."""


@dataclass(frozen=True)
class Reply:
    """Status code, and the list under `_embedded._state`."""

    code: int
    states: list[dict[str, Any]] | None


Answer = Callable[[str, str, dict[str, str], bytes], Reply | None]
"""Maps method, path, query and body to a reply; None leaves the client waiting."""


class HttpServer:
    """An HTTP server; clients without an answer wait until it is closed."""

    def __init__(self, host: str, port: int, answer: Answer) -> None:
        self._server = _RobotServer((host, port), answer)
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(0.02,), daemon=True
        )
        self._thread.start()

    @property
    def sessions(self) -> int:
        """Number of logged-in clients."""
        return len(self._server.sessions)

    def cut(self) -> None:
        """Close the open connections."""
        self._server.cut()

    def close(self) -> None:
        """Close every connection and release the port."""
        self._server.released.set()
        self._server.shutdown()
        self._server.cut()
        self._server.server_close()
        self._thread.join(_END_S)


class _RobotServer(ThreadingHTTPServer):
    daemon_threads = True
    block_on_close = False
    allow_reuse_address = True

    def __init__(self, address: tuple[str, int], answer: Answer) -> None:
        super().__init__(address, _Handler)
        self.answer = answer
        self.released = threading.Event()
        self.nonce = secrets.token_hex(16)
        self._open: set[socket.socket] = set()
        self.sessions: set[str] = set()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._open.add(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._open.discard(request)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a client that disconnects during a request."""

    def cut(self) -> None:
        """Shut down every connection."""
        for request in list(self._open):
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: _RobotServer
    timeout = 30
    _session = ""

    def log_message(self, format: str, *args: Any) -> None:
        """Log nothing."""

    def _serve(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if not self._is_allowed():
            self._send(Reply(401, None))
            return
        if not self._log_in():
            self._send(Reply(503, None))
            return
        parts = urlsplit(self.path)
        # The client writes `?action=set?json=1` for some requests.
        query = dict(parse_qsl(parts.query.replace("?", "&")))
        path = unquote(parts.path).lstrip("/")
        reply = self.server.answer(self.command, path, query, body)
        if reply is None:
            self.server.released.wait()
            self.close_connection = True
            return
        if path == "logout":
            self.server.sessions.discard(self._session)
        self._send(reply)

    do_GET = do_POST = do_PUT = do_DELETE = _serve

    def _log_in(self) -> bool:
        """Find the session of the request's cookie, or open one below the limit."""
        sent = re.search(rf"{_COOKIE}=(\w+)", self.headers.get("Cookie", ""))
        self._session = sent[1] if sent else ""
        if self._session in self.server.sessions:
            return True
        if len(self.server.sessions) >= MOST_SESSIONS:
            return False
        self._session = secrets.token_hex(8)
        self.server.sessions.add(self._session)
        return True

    def _is_allowed(self) -> bool:
        """Check the RFC 2617 digest with MD5 and qop=auth, as the controller does."""
        header = self.headers.get("Authorization", "")
        found = re.findall(r'(\w+)=(?:"([^"]*)"|([^\s,]+))', header)
        sent = {name: quoted or plain for name, quoted, plain in found}
        if sent.get("nonce") != self.server.nonce or sent.get("username") != USER:
            return False
        secret = _md5(f"{USER}:{REALM}:{PASSWORD}")
        request = _md5(f"{self.command}:{sent.get('uri')}")
        parts = (
            secret,
            sent["nonce"],
            sent.get("nc"),
            sent.get("cnonce"),
            sent.get("qop"),
            request,
        )
        return sent.get("response") == _md5(":".join(map(str, parts)))

    def _send(self, reply: Reply) -> None:
        data = b""
        if reply.states is not None:
            data = json.dumps({"_embedded": {"_state": reply.states}}).encode()
        self.send_response(reply.code)
        if reply.code == 401:
            challenge = f'Digest realm="{REALM}", nonce="{self.server.nonce}", qop="auth"'
            self.send_header("WWW-Authenticate", challenge)
        if self._session:
            self.send_header("Set-Cookie", f"{_COOKIE}={self._session}; path=/")
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        self.wfile.write(data)


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
