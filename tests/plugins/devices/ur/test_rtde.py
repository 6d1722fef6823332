"""The RTDE reader on a controller that sends what it should not: each ends it, in time."""

from __future__ import annotations

import math
import socket
import struct
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from sliplab.plugins.devices.ur.rtde import (
    DATA,
    GET_VERSION,
    HEADER,
    REQUEST_PROTOCOL_VERSION,
    SETUP_OUTPUTS,
    START,
    TEXT,
    RtdeError,
    RtdeReader,
)
from sliplab.plugins.devices.ur.settings import RTDE_PORT
from tests.rigs.waiting import own_address

LIMIT_S = 0.3
BUSY_S = 5.0
NEVER_ENDING = b"never ending"


def message(command: int, body: bytes) -> bytes:
    return HEADER.pack(HEADER.size + len(body), command) + body


def packet(*values: float, recipe: int = 1) -> bytes:
    return message(DATA, bytes([recipe]) + struct.pack(f">{len(values)}d", *values))


ANSWERS = {
    REQUEST_PROTOCOL_VERSION: b"\x01",
    GET_VERSION: struct.pack(">4I", 5, 11, 1, 0),
    SETUP_OUTPUTS: b"\x01DOUBLE",
    START: b"\x01",
}
CHATTER = message(TEXT, b"a message nobody asked for")


@contextmanager
def controller(sends: bytes, answers: dict[int, bytes] = ANSWERS) -> Iterator[str]:
    """A port that answers the set-up, then sends `sends`; chatter follows where it says so.

    An answer that is left out is chatter without end instead.
    """
    host = own_address()
    door = socket.create_server((host, RTDE_PORT))
    ending = threading.Event()

    def chatter(link: socket.socket) -> None:
        while not ending.wait(0.001):
            link.sendall(CHATTER)

    def serve() -> None:
        link, _ = door.accept()
        with link:
            try:
                for command in (REQUEST_PROTOCOL_VERSION, GET_VERSION, SETUP_OUTPUTS, START):
                    size, _ = HEADER.unpack(link.recv(HEADER.size, socket.MSG_WAITALL))
                    if size > HEADER.size:
                        link.recv(size - HEADER.size, socket.MSG_WAITALL)
                    if command not in answers:
                        chatter(link)
                        return
                    link.sendall(message(command, answers[command]))
                link.sendall(sends.removesuffix(NEVER_ENDING))
                if sends.endswith(NEVER_ENDING):
                    chatter(link)
                ending.wait(BUSY_S)
            except OSError:
                pass  # the reader has left

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield host
    finally:
        ending.set()
        thread.join(BUSY_S)
        door.close()


def read_all(host: str) -> None:
    """Every packet until the reader gives up, which it must."""
    reader = RtdeReader(host, LIMIT_S, LIMIT_S)
    reader.open(["timestamp"], 125)
    try:
        while True:
            reader.read()
    finally:
        reader.close()


STREAMS: dict[str, tuple[bytes, str]] = {
    "size 0": (packet(1.0) + struct.pack(">HB", 0, DATA), "size 0"),
    "size 2": (packet(1.0) + struct.pack(">HB", 2, DATA), "size 2"),
    "size 65535": (packet(1.0) + struct.pack(">HB", 65535, DATA) + packet(2.0), "timed out"),
    "wrong recipe": (packet(1.0, recipe=2), "recipe 2"),
    "too long": (packet(1.0, 2.0), "17 bytes"),
    "empty": (message(DATA, b""), "0 bytes"),
    "not a number": (packet(math.nan), "not finite"),
    "infinite": (packet(math.inf), "not finite"),
    "no command": (message(0, b"xxx"), "command 0"),
    "chatter without end": (packet(1.0) + NEVER_ENDING, "no packet"),
    "speaks HTTP": (b"HTTP/1.1 400 Bad Request\r\n\r\n", "not an RTDE packet"),
}


@pytest.mark.parametrize(("sends", "why"), STREAMS.values(), ids=list(STREAMS))
def test_a_stream_that_is_not_what_was_agreed_on_has_ended(sends: bytes, why: str) -> None:
    with controller(sends) as host:
        began = time.monotonic()
        with pytest.raises(RtdeError, match=why):
            read_all(host)
        assert time.monotonic() - began < 2 * LIMIT_S + BUSY_S


@pytest.mark.parametrize("missing", list(ANSWERS))
def test_chatter_instead_of_an_answer_does_not_hold_up_connecting(missing: int) -> None:
    answers = {command: body for command, body in ANSWERS.items() if command != missing}
    with controller(b"", answers) as host:
        reader = RtdeReader(host, LIMIT_S, LIMIT_S)
        began = time.monotonic()
        with pytest.raises(RtdeError, match="cannot read from"):
            reader.open(["timestamp"], 125)
        assert time.monotonic() - began < LIMIT_S + BUSY_S


def test_messages_between_packets_are_let_through() -> None:
    with controller(packet(1.0) + CHATTER + packet(2.0)) as host:
        reader = RtdeReader(host, LIMIT_S, LIMIT_S)
        reader.open(["timestamp"], 125)
        values: list[tuple[float, ...]] = []
        while len(values) < 2:
            values += [one.values for one in reader.read()]
        reader.close()
    assert values == [(1.0,), (2.0,)]
