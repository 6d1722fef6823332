"""A DVXplorer that somebody else feeds while it runs: a process that passes on what it is sent.

Like the server in `dvxplorer.py` it writes with dv-processing's own `NetworkWriter`, and for the
same reasons in a process of its own. It sends each packet as it comes and counts what has left, so
that both ends can be compared.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any

from rigs.cameras.settings import DvxplorerSettings, NetworkStream
from rigs.wire.dvxplorer import CLIENT_S, ServerError, made, open_writers
from storage.streams import I64, U8, U16, EventChunk, PulseChunk

START_S = 60.0
"""The longest that the process takes to begin, s."""
SEND_S = 10.0
"""The longest that `send` waits for a process that does not keep up, s."""
AHEAD = 256
"""Packets that may wait to be passed on."""
_LOOK_S = 0.001
_EVENTS, _TRIGGERS, _UNHEARD, _CLIENTS, _LEFT = range(5)
_Packet = tuple[I64, U16, U16, U8, I64]


class LiveDvxplorer:
    """An event camera on two network streams that shows what `send` gives it.

    Attributes:
        events_given, pulses_given: what `send` was given since it was made.
    """

    def __init__(self, size: tuple[int, int] = (640, 480)) -> None:
        context = get_context("spawn")
        self._pipe, theirs = context.Pipe()
        # one writer, and a look at any time: no lock is needed
        self._told = context.RawArray("q", 5)
        self._process = context.Process(
            target=_serve, args=(theirs, self._told, size), name="live DVXplorer", daemon=True
        )
        self._process.start()
        theirs.close()
        self.events_given = self.pulses_given = self._given = 0
        self._ahead: queue.Queue[_Packet | None] = queue.Queue(AHEAD)
        self._broken = False
        self._thread = threading.Thread(target=self._pass_on, name="live events", daemon=True)
        try:
            if not self._pipe.poll(START_S):
                raise ServerError(f"the process has not begun within {START_S:g} s")
            said, value = self._pipe.recv()
            if said != "ready":
                raise ServerError(f"the process cannot serve: {value}")
        except (EOFError, OSError, ServerError) as error:
            self._end()
            raise ServerError(str(error) or "the process has ended at once") from None
        self.events_port, self.triggers_port = value
        self._thread.start()

    @property
    def settings(self) -> DvxplorerSettings:
        """Settings of a driver that listens to it."""
        return DvxplorerSettings(
            source=NetworkStream(events_port=self.events_port, triggers_port=self.triggers_port)
        )

    def send(self, chunk: EventChunk, pulses: PulseChunk) -> None:
        """Pass on events and rising edges, in order of time over all calls; returns at once.

        Args:
            chunk: events, us of the camera's clock.
            pulses: rising edges of its input, ns of the same clock, rounded down to us.

        Raises:
            ServerError: the process has ended, or has not kept up for `SEND_S`.
        """
        if not (len(chunk) or len(pulses)):
            return
        if self._broken:
            raise ServerError("the process has ended")
        packet = (chunk.t_us, chunk.x, chunk.y, chunk.p, pulses.t_ns // 1000)
        try:
            self._ahead.put(packet, timeout=SEND_S)
        except queue.Full:
            raise ServerError(f"the process has not kept up for {SEND_S:g} s") from None
        self._given += 1
        self.events_given += len(chunk)
        self.pulses_given += len(pulses)

    @property
    def events_sent(self) -> int:
        """Events that the process has written to a client."""
        return int(self._told[_EVENTS])

    @property
    def triggers_sent(self) -> int:
        """Triggers that the process has written to a client."""
        return int(self._told[_TRIGGERS])

    @property
    def unheard(self) -> int:
        """Events and triggers that came while nobody was connected."""
        return int(self._told[_UNHEARD])

    @property
    def heard(self) -> bool:
        """Whether both streams had a client when the process looked last."""
        return bool(self._told[_CLIENTS])

    def settle(self, timeout_s: float) -> None:
        """Return when all that was given has left the process.

        Raises:
            ServerError: it has not within `timeout_s`.
        """
        end, idle = time.monotonic() + timeout_s, threading.Event()
        while self._told[_LEFT] < self._given:
            if self._broken or time.monotonic() > end:
                left = self._given - self._told[_LEFT]
                raise ServerError(f"{left} packets have not left within {timeout_s:g} s")
            idle.wait(_LOOK_S)

    def close(self) -> None:
        """End the process, whatever it does; the streams break."""
        self._end()
        with suppress(queue.Full):
            self._ahead.put_nowait(None)
        self._thread.join(SEND_S)

    def __enter__(self) -> LiveDvxplorer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _end(self) -> None:
        self._broken = True
        self._process.kill()
        self._process.join(CLIENT_S)
        self._pipe.close()

    def _pass_on(self) -> None:
        """A full pipe waits for the process: not the caller but this thread waits with it."""
        try:
            while (packet := self._ahead.get()) is not None:
                self._pipe.send(packet)
        except OSError:
            self._broken = True


def _serve(pipe: Connection, told: Any, size: tuple[int, int]) -> None:
    """The process; it never returns, for taking a writer down may wait for ever."""
    status, written = 1, 0
    try:
        (events, triggers), ports = open_writers(size)
        pipe.send(("ready", ports))
        while True:
            there = events.getClientCount() > 0, triggers.getClientCount() > 0
            told[_CLIENTS] = all(there)
            if not (events.getQueuedPacketCount() or triggers.getQueuedPacketCount()):
                told[_LEFT] = written
            if not pipe.poll(_LOOK_S):
                continue
            t_us, x, y, p, pulses_us = pipe.recv()
            packet = made(EventChunk(x, y, p, t_us), pulses_us)
            told[_EVENTS if there[0] else _UNHEARD] += packet.events
            told[_TRIGGERS if there[1] else _UNHEARD] += packet.pulses
            if packet.events and there[0]:
                events.writeEvents(packet.store)
            if packet.pulses and there[1]:
                triggers.writeTriggers(packet.triggers)
            written += 1
    except (EOFError, ConnectionError):
        status = 0
    except Exception as error:
        with suppress(OSError):
            pipe.send(("failed", repr(error)))
    os._exit(status)
