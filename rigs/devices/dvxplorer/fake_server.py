"""A port that serves one of dv's network streams to whoever connects, from a thread that rests."""

from __future__ import annotations

import socket
import threading
from collections import deque
from contextlib import suppress

MOST_WAITING = 256 << 20
"""Bytes that may wait for a client to take them; then the stream breaks, as a camera's would."""
SEND_S = 10.0
"""A client that has taken nothing for so long is cut off, s."""
JOIN_S = 2.0


class DvServer:
    """Serves a stream on a free loopback port until `close`.

    Args:
        header: sent to each client first.

    Attributes:
        port: where it listens.
    """

    def __init__(self, header: bytes) -> None:
        self._header = header
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self._clients: list[socket.socket] = []
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._closing = False
        self._threads = [
            threading.Thread(target=work, name=f"dv stream {self.port}", daemon=True)
            for work in (self._accept, self._send)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def clients(self) -> int:
        """How many are connected."""
        with self._changed:
            return len(self._clients)

    @property
    def waiting(self) -> int:
        """Packets that have not left yet."""
        with self._changed:
            return len(self._waiting)

    def send(self, packet: bytes) -> None:
        """Hand a packet to every client that is there; returns at once."""
        with self._changed:
            if self._closing or not self._clients:
                return
            self._waiting.append(packet)
            self._bytes += len(packet)
            if self._bytes > MOST_WAITING:
                self._cut()
            self._changed.notify_all()

    def wait_for_client(self, within_s: float) -> bool:
        """Whether somebody is connected, after waiting for it."""
        with self._changed:
            return self._changed.wait_for(lambda: bool(self._clients), within_s)

    def drain(self, within_s: float) -> bool:
        """Whether everything has left, after waiting for it."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._waiting, within_s)

    def close(self) -> None:
        """Cut every client and give the port back; any number of times."""
        with self._changed:
            self._closing = True
            self._cut()
            self._changed.notify_all()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        for thread in self._threads:
            thread.join(JOIN_S)

    def _cut(self) -> None:
        for client in self._clients:
            with suppress(OSError):
                client.shutdown(socket.SHUT_RDWR)
            client.close()
        self._clients = []
        self._waiting.clear()
        self._bytes = 0

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.settimeout(SEND_S)
            with suppress(OSError):
                client.sendall(self._header)
                with self._changed:
                    if self._closing:
                        client.close()
                        return
                    self._clients.append(client)
                    self._changed.notify_all()

    def _send(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if self._closing:
                    return
                packet, clients = self._waiting[0], list(self._clients)
            for client in clients:
                try:
                    client.sendall(packet)
                except OSError:
                    with self._changed:
                        if client in self._clients:
                            self._clients.remove(client)
                    client.close()
            with self._changed:
                if self._waiting and self._waiting[0] is packet:
                    self._waiting.popleft()
                    self._bytes -= len(packet)
                self._changed.notify_all()
