"""Connections whose answers have one limit each of time and size."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from sliplab.rigs.core.network import BoundedSocket

pytestmark = pytest.mark.realtime


@pytest.fixture
def pair() -> Iterator[tuple[BoundedSocket, socket.socket]]:
    """A connection, and its other end."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = BoundedSocket.open("127.0.0.1", server.getsockname()[1], 5.0)
        other, _ = server.accept()
        with link, other:
            yield link, other


def test_answer_in_pieces_has_one_deadline(pair: tuple[BoundedSocket, socket.socket]) -> None:
    link, other = pair

    def drip() -> None:
        with suppress(OSError):
            while True:
                other.sendall(b"x")
                threading.Event().wait(0.02)

    threading.Thread(target=drip, daemon=True).start()
    link.expect(0.3)
    began, came = time.monotonic(), b""
    with pytest.raises(TimeoutError), link.makefile("rb") as file:
        came = file.readline()
    assert came == b""
    assert time.monotonic() - began < 3.0
    link.expect(5.0)
    assert link.receive(1) == b"x"


def test_answer_has_a_largest_size(pair: tuple[BoundedSocket, socket.socket]) -> None:
    link, other = pair
    other.sendall(b"x" * 11)
    link.expect(5.0, most_bytes=10)
    assert link.recv(10, socket.MSG_WAITALL) == b"x" * 10
    with pytest.raises(ConnectionError, match="does not end"):
        link.receive(1)


def test_end_of_the_connection_is_an_error(pair: tuple[BoundedSocket, socket.socket]) -> None:
    link, other = pair
    other.close()
    link.expect(5.0)
    with pytest.raises(ConnectionError, match="closed the connection"):
        link.receive(1)


def test_refused_connection_is_an_error() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(ConnectionError):
        BoundedSocket.open("127.0.0.1", port, 5.0)
