"""A fake DVXplorer: a process that serves events and triggers over the network.

It serves dv's two network streams, one port for events and one for triggers, and reports at its end
what it sent, so that both ends can be compared. It is a separate process because the library's
reader holds Python's interpreter lock while it connects, and a server in the same process could not
answer.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from sliplab.plugins.devices.dvxplorer.fake_stream import (
    DvServer,
    events_header,
    events_packet,
    triggers_header,
    triggers_packet,
)
from sliplab.plugins.devices.dvxplorer.settings import DvxplorerSettings, NetworkStream
from sliplab.plugins.simulation.scene.events import MarkerSensor
from sliplab.plugins.simulation.scene.optics import EventOptics
from sliplab.storage.process import leave_to_parent, out_of_reach
from sliplab.storage.spawn_context import WORKERS, check_work
from sliplab.storage.streams import I64, EventChunk

Packet = tuple[EventChunk, I64]
"""Events, and the rising edges that belong to them, us of the camera's clock."""
Source = Callable[[], Iterable[Packet]]
READY_S = 600.0
"""Timeout to generate all packets, s."""
CLIENT_S = 30.0
"""Timeout for the client to connect, and for the queue to be sent, s."""
_MOST_WAITING = 256
"""Queue length above which the next packet waits for the client."""


@dataclass(frozen=True)
class Sent:
    """Counts of the data that a server has sent."""

    events: int
    pulses: int
    packets: int
    seconds: float


class FakeServerError(RuntimeError):
    """The serving process failed or timed out."""


class DvxplorerServer:
    """A process that generates packets, and sends them on command.

    Args:
        source: generates the packets; called in the process, so it must be a module-level function
            or a `functools.partial` of one.
        realtime: True to send each packet when its last event is due; else as fast as possible.
        stall_after: number of packets after which the server pauses until `resume`.
        size: columns and rows in the stream's header.
    """

    def __init__(
        self,
        source: Source,
        *,
        realtime: bool = True,
        stall_after: int | None = None,
        size: tuple[int, int] = (640, 480),
    ) -> None:
        check_work(source)
        self._pipe, theirs = WORKERS.Pipe()
        self._process = WORKERS.Process(
            target=_serve, args=(theirs, source, realtime, stall_after, size), daemon=True
        )
        with out_of_reach():
            self._process.start()
        theirs.close()
        try:
            self.events_port, self.triggers_port = self._expect("ready", READY_S)
        except FakeServerError:
            self.close()
            raise

    @property
    def settings(self) -> DvxplorerSettings:
        """Settings of a driver for this server."""
        return DvxplorerSettings(
            source=NetworkStream(events_port=self.events_port, triggers_port=self.triggers_port)
        )

    def go(self) -> None:
        """Start sending once both streams have a client."""
        self._pipe.send("go")

    def await_stall(self, timeout_s: float) -> None:
        """Wait until the server has paused at `stall_after`. Raises ServerError."""
        self._expect("stalled", timeout_s)

    def resume(self) -> None:
        """Continue after a stall."""
        self._pipe.send("resume")

    @property
    def answered(self) -> bool:
        """True if the process has reported, so that `finish` need not wait."""
        return self._pipe.poll(0)

    def finish(self, timeout_s: float) -> Sent:
        """Wait until everything is sent, and return its counts. Raises ServerError."""
        sent: Sent = self._expect("sent", timeout_s)
        return sent

    def close(self) -> None:
        """Kill the process; the streams break."""
        self._process.kill()
        self._process.join(CLIENT_S)
        self._pipe.close()

    def __enter__(self) -> DvxplorerServer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _expect(self, wanted: str, timeout_s: float) -> Any:
        try:
            if not self._pipe.poll(timeout_s):
                raise FakeServerError(
                    f"the server did not report '{wanted}' within {timeout_s:g} s"
                )
            stated, value = self._pipe.recv()
        except (EOFError, OSError):
            raise FakeServerError(f"the server ended before it reported '{wanted}'") from None
        if stated != wanted:
            raise FakeServerError(f"the server reported '{stated}' instead of '{wanted}': {value}")
        return value


def arrays(chunk: EventChunk, pulses_us: I64, packet_us: int) -> Iterator[Packet]:
    """Split arrays in order of time into packets of `packet_us`, with the pulses of each interval.

    An interval without events also has a packet, for its pulses.
    """
    every = np.concatenate([chunk.t_us[[0, -1]] if len(chunk) else [], pulses_us]).astype(np.int64)
    if not len(every):
        return
    edges = np.arange(every.min(), every.max() + packet_us + 1, packet_us)
    rows, marks = np.searchsorted(chunk.t_us, edges), np.searchsorted(pulses_us, edges)
    for k in range(len(edges) - 1):
        yield chunk[rows[k] : rows[k + 1]], pulses_us[marks[k] : marks[k + 1]]


def scene(seconds: float, seed: int = 1) -> Iterator[Packet]:
    """Generate packets of seven markers pushed back and forth in contact; a pulse every 10 ms.

    Simulated: normal force 0.3 N on a tip, tangential 0.1 N once a second.
    """
    optics = EventOptics()
    ring = 5.6 * np.exp(2j * np.pi * np.arange(6) / 6)
    places = np.concatenate(([0j], ring))
    sensor = MarkerSensor(optics, np.stack((places.real, places.imag), axis=-1), seed)

    def load(t_ns: I64) -> np.ndarray[Any, np.dtype[np.float64]]:
        push = 0.1 * np.sin(2 * np.pi * t_ns / 1e9)
        still = np.zeros_like(push)
        # per tip: tangential x and y, normal
        columns = [push, still, np.full_like(push, 0.3)] * len(places)
        return np.ascontiguousarray(np.stack(columns, axis=-1))

    sensor.reset(load(np.zeros(1, np.int64))[0], seed)
    for begin in range(0, round(seconds * 1e9), optics.block_ns):
        t_ns = np.arange(begin, begin + optics.block_ns + 1, 1_000_000)
        when, x, y, p = sensor.sense(load(t_ns), t_ns)
        pulses = np.arange(-(-begin // 10**7) * 10**7, begin + optics.block_ns, 10**7) // 1000
        yield EventChunk(x, y, p, when // 1000), pulses


def _serve(
    pipe: Connection,
    source: Source,
    realtime: bool,
    stall_after: int | None,
    size: tuple[int, int],
) -> None:
    """Run the serving process; never returns."""
    leave_to_parent()
    status = 1
    try:
        packets = [_made(*packet) for packet in source()]
        events = DvServer(events_header(size, "stand-in"))
        triggers = DvServer(triggers_header("stand-in"))
        pipe.send(("ready", (events.port, triggers.port)))
        if pipe.recv() == "go":
            pipe.send(("sent", _send(pipe, packets, (events, triggers), realtime, stall_after)))
            pipe.recv()  # ends when the other side closes
    except (EOFError, ConnectionError):
        status = 0
    except Exception as error:
        with suppress(OSError):
            pipe.send(("failed", repr(error)))
    os._exit(status)


@dataclass(frozen=True)
class _Made:
    """A serialised packet for each of the two streams."""

    on_events: bytes
    on_triggers: bytes
    events: int
    pulses: int
    end_us: int


def _made(chunk: EventChunk, pulses_us: I64) -> _Made:
    ends = [int(times[-1]) for times in (chunk.t_us, pulses_us) if len(times)]
    return _Made(
        events_packet(chunk) if len(chunk) else b"",
        triggers_packet(pulses_us) if len(pulses_us) else b"",
        len(chunk),
        len(pulses_us),
        max(ends, default=0),
    )


def _send(
    pipe: Connection,
    packets: list[_Made],
    servers: tuple[DvServer, DvServer],
    realtime: bool,
    stall_after: int | None,
) -> Sent:
    events, triggers = servers
    for server in servers:
        if not server.wait_for_client(CLIENT_S):
            raise TimeoutError(f"no client connected within {CLIENT_S:g} s")
    began = time.monotonic()
    first_us = packets[0].end_us if packets else 0
    sent_events = sent_pulses = 0
    for number, packet in enumerate(packets):
        if number == stall_after:
            pipe.send(("stalled", None))
            pipe.recv()
        wait = began + (packet.end_us - first_us) / 1e6 - time.monotonic()
        # nothing is sent meanwhile: this only lets time pass, and detects the parent's end
        if realtime and wait > 0 and pipe.poll(wait):
            pipe.recv()
        if packet.events:
            events.send(packet.on_events)
        if packet.pulses:
            triggers.send(packet.on_triggers)
        if events.waiting > _MOST_WAITING and not events.drain(CLIENT_S):
            raise TimeoutError(f"the client has done nothing for {CLIENT_S:g} s")
        sent_events += packet.events
        sent_pulses += packet.pulses
    for server in servers:
        if not server.drain(CLIENT_S):
            raise TimeoutError(f"the client has done nothing for {CLIENT_S:g} s")
    return Sent(sent_events, sent_pulses, len(packets), time.monotonic() - began)
