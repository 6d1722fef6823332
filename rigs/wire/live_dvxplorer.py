"""A DVXplorer on the network that sends what it is given, as it is given it.

A process of its own, like `rigs.wire.dvxplorer`: a writer of dv-processing 2.0.4 that is taken
down may wait for ever, so the process ends without.
"""

from __future__ import annotations

import os
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection

from rigs.wire.dvxplorer import CLIENT_S, READY_S, ServerError, made_packet, open_writers
from storage.streams import EventChunk, PulseChunk


class LiveDvxplorer:
    """An event camera whose data come from elsewhere in this process.

    Args:
        size: columns and rows.

    Attributes:
        ports: of events and of triggers.

    Raises:
        ServerError: the process does not begin.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(
            target=_serve, args=(theirs, size), name="event camera", daemon=True
        )
        self._process.start()
        theirs.close()
        self._silent = False
        try:
            if not self._pipe.poll(READY_S):
                raise ServerError(f"the event camera's stand-in is not ready in {READY_S:g} s")
            self.ports: tuple[int, int] = self._pipe.recv()
        except (EOFError, OSError):
            raise ServerError("the event camera's stand-in ended before it was ready") from None

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Send events, and rising edges of its input; nothing while it is stalled or unplugged."""
        if not self._silent:
            with suppress(OSError):
                self._pipe.send((chunk, pulses.t_ns // 1000))

    def stall(self) -> None:
        """Send nothing from now on; the connection stays."""
        self._silent = True

    def close(self) -> None:
        """End the process, whatever it does: the cable is pulled. Any number of times."""
        self._silent = True
        self._process.kill()
        self._process.join(CLIENT_S)
        self._pipe.close()


def _serve(pipe: Connection, size: tuple[int, int]) -> None:
    status = 1
    try:
        (events, triggers), ports = open_writers(size)
        pipe.send(ports)
        while True:
            packet = made_packet(*pipe.recv())
            if packet.events:
                events.writeEvents(packet.store)
            if packet.pulses:
                triggers.writeTriggers(packet.triggers)
    except (EOFError, ConnectionError, KeyboardInterrupt):
        status = 0
    finally:
        os._exit(status)
