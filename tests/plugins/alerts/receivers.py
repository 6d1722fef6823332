"""Servers of a test that take what alerts send: by HTTP, and by mail (SMTP)."""

from __future__ import annotations

import json
import socketserver
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any


class _MailServer(socketserver.ThreadingTCPServer):
    allow_reuse_address = True


@contextmanager
def http_server(port: int = 0) -> Iterator[tuple[int, list[Any]]]:
    """A server that keeps what is posted to it, and the paths that are fetched; yields its port."""
    taken: list[Any] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            taken.append(self.path)
            self.send_response(204)
            self.end_headers()

        def do_POST(self) -> None:
            taken.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.send_response(200)
            self.end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            """Print nothing."""

    with ThreadingHTTPServer(("127.0.0.1", port), Handler) as server, _running(server):
        yield server.server_port, taken


@contextmanager
def mail_server(port: int = 0) -> Iterator[tuple[int, list[str]]]:
    """A mail server that keeps what it gets; yields its port."""
    mails: list[str] = []

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            self.wfile.write(b"220 test\r\n")
            while line := self.rfile.readline():
                verb = line[:4].upper()
                if verb == b"DATA":
                    self.wfile.write(b"354 go\r\n")
                    body = b""
                    while (part := self.rfile.readline()) != b".\r\n":
                        body += part
                    mails.append(body.decode().replace("=\r\n", ""))
                self.wfile.write(b"221 bye\r\n" if verb == b"QUIT" else b"250 ok\r\n")
                if verb == b"QUIT":
                    return

    with _MailServer(("127.0.0.1", port), Handler) as server, _running(server):
        yield server.server_address[1], mails


@contextmanager
def _running(server: socketserver.BaseServer) -> Iterator[None]:
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield
    finally:
        server.shutdown()
        thread.join()
