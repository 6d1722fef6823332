"""Web services whose answers do not end: one deadline per answer, and a bounded size."""

from __future__ import annotations

import socket
import threading
import time
from contextlib import suppress

import pytest

from sliplab.plugins.devices.abb.rws import REQUEST_S, WebError, WebServices
from sliplab.plugins.devices.abb.settings import AbbSettings
from tests.plugins.devices.conftest import LIMITS

pytestmark = pytest.mark.realtime

SLACK_S = 1.5
HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: 100000000\r\n\r\n"


def serve(server: socket.socket, at_once: bytes, slowly: bytes) -> None:
    """Answer every client with some bytes at once, and more in pieces."""

    def answer(link: socket.socket) -> None:
        with link, suppress(OSError):
            link.recv(4096)
            link.sendall(at_once)
            while slowly:
                link.sendall(slowly)
                threading.Event().wait(0.05 if len(slowly) == 1 else 0.0)

    with suppress(OSError):
        while True:
            link, _ = server.accept()
            threading.Thread(target=answer, args=(link,), daemon=True).start()


@pytest.mark.parametrize(
    ("at_once", "slowly"),
    [(b"", b""), (b"", b"H"), (HEAD[:40], b"x"), (HEAD, b" "), (HEAD, b" " * 65536)],
    ids=["nothing", "status line", "head", "body", "flood"],
)
def test_answer_that_does_not_end_has_one_deadline(at_once: bytes, slowly: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, args=(server, at_once, slowly), daemon=True).start()
        web = WebServices(
            AbbSettings(host="127.0.0.1", rws_port=server.getsockname()[1], limits=LIMITS)
        )
        began = time.monotonic()
        with pytest.raises(WebError, match="do not answer"):
            web.is_running()
        assert time.monotonic() - began < REQUEST_S + SLACK_S
        web.close()
