"""Devices on the network or a serial port: bounded answers, and the lock of an arm."""

from __future__ import annotations

import math
import os
import socket
import threading
import time
from contextlib import suppress
from typing import Any

from sliplab.rigs.core.arm_settings import BaseArmSettings

ANSWER_S = 1.0
"""Timeout of a connection, s."""

RESOLVE_S = 2.0
"""Timeout for the address of a host name, s."""

MOST_BYTES = 1 << 20
"""Largest answer of a device, bytes."""


class BoundedSocket(socket.socket):
    """A TCP connection whose answers have a limit each of time and size, in any number of pieces.

    A timeout of a socket is that of one `recv`: a device that sends a byte now and then never
    exceeds it. `expect` begins an answer; reading beyond its limits raises OSError.
    """

    _deadline = math.inf
    _left = 0

    @classmethod
    def open(cls, host: str, port: int, within_s: float) -> BoundedSocket:
        """Connect, and expect a first answer within the same time. Raises OSError."""
        began = time.monotonic()
        link = cls(fileno=socket.create_connection((host, port), within_s).detach())
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.expect(within_s - (time.monotonic() - began))
        return link

    def expect(self, within_s: float, most_bytes: int = MOST_BYTES) -> None:
        """Begin an answer that ends within `within_s` and has at most `most_bytes`."""
        self._deadline, self._left = time.monotonic() + within_s, most_bytes
        self._wait()

    def receive(self, most: int) -> bytes:
        """Return received bytes, at least one and at most `most`. Raises OSError."""
        data = self.recv(most)
        if not data:
            raise ConnectionError("it closed the connection")
        return data

    def recv(self, size: int, flags: int = 0) -> bytes:
        """Return received bytes, at most `size`; none at the end of the connection."""
        self._wait()
        data = super().recv(size, flags)
        self._count(len(data))
        return data

    def recv_into(self, buffer: Any, size: int = 0, flags: int = 0) -> int:
        """Read into a buffer, as `http.client` does; return the number of bytes."""
        self._wait()
        came = super().recv_into(buffer, size, flags)
        self._count(came)
        return came

    def _wait(self) -> None:
        left_s = self._deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("timed out")
        self.settimeout(left_s)

    def _count(self, came: int) -> None:
        self._left -= came
        if self._left < 0:
            raise ConnectionError("its answer does not end")


def answers(host: str, port: int) -> str | None:
    """Return None if a port accepts a TCP connection within `ANSWER_S`, else the reason."""
    try:
        with socket.create_connection((host, port), ANSWER_S):
            return None
    except OSError as error:
        return f"{host}:{port}: {error}; check its power, its cable and the address"


def serial_port(port: str) -> str | None:
    """Return None if a serial port may be opened, else the reason."""
    if not os.path.exists(port):
        return f"there is no {port}; check its cable and /dev/serial/by-id"
    if not os.access(port, os.R_OK | os.W_OK):
        return f"{port} may not be opened; add yourself to its group (dialout)"
    return None


def arm_lock(settings: BaseArmSettings) -> dict[str, str]:
    """Return the locks of an arm: one program at a time at a controller's address.

    The addresses of a host name are locked, too: another rig file may have another of its names.
    """
    host = settings.host.lower()
    return {f"arm-{name}": f"the arm at {host}" for name in (host, *addresses(host))}


def addresses(host: str, within_s: float = RESOLVE_S) -> list[str]:
    """Return the addresses of a host; none if they are not found within a time.

    A resolver may wait for its servers for long, and cannot be interrupted: it is left behind.
    """
    found: list[str] = []

    def resolve() -> None:
        with suppress(OSError, UnicodeError):
            infos = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
            found.extend(sorted({str(info[4][0]) for info in infos}))

    thread = threading.Thread(target=resolve, daemon=True)
    thread.start()
    thread.join(within_s)
    return list(found)
