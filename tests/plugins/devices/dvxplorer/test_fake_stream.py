"""Our bytes are dv-processing's: against its own writer, and through its own reader."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.devices.dvxplorer.fake_stream import (
    DvServer,
    events_header,
    events_packet,
    triggers_header,
    triggers_packet,
)
from sliplab.storage.streams import EventChunk
from tests.rigs.waiting import free_port

_WRITER = """
import os, sys
import dv_processing as dv
port, kind = int(sys.argv[1]), sys.argv[2]
made = {"events": lambda: dv.io.Stream.EventStream(0, "events", "stand-in", (640, 480)),
        "triggers": lambda: dv.io.Stream.TriggerStream(0, "triggers", "stand-in")}[kind]()
writer = dv.io.NetworkWriter("127.0.0.1", port, made)
print("ready", flush=True)
sys.stdin.readline()
if kind == "events":
    store = dv.EventStore()
    for row in [(1000000, 3, 4, True), (1000007, 639, 479, False)]:
        store.push_back(*row)
    writer.writeEvents(store)
else:
    rising = dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE
    writer.writeTriggers(dv.TriggerPacket.TriggersVector([dv.Trigger(77, rising)]))
sys.stdin.readline()
os._exit(0)  # taking a writer down may wait for ever
"""


def library_bytes(kind: str, count: int) -> bytes:
    """The first `count` bytes that dv-processing's writer sends."""
    port = free_port()
    command = [sys.executable, "-c", _WRITER, str(port), kind]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        with socket.create_connection(("127.0.0.1", port), 10.0) as link:
            link.settimeout(10.0)
            data = link.recv(1)
            process.stdin.write("\n")
            process.stdin.flush()
            while len(data) < count:
                data += link.recv(count - len(data))
        process.stdin.write("\n")
        process.stdin.close()
    return data


def chunk_of(n: int, seed: int = 1) -> EventChunk:
    rng = np.random.default_rng(seed)
    return EventChunk(
        rng.integers(0, 640, n).astype(np.uint16),
        rng.integers(0, 480, n).astype(np.uint16),
        rng.integers(0, 2, n).astype(np.uint8),
        np.sort(rng.integers(0, 1 << 50, n)),
    )


@pytest.mark.realtime
def test_events_are_the_librarys_to_the_byte() -> None:
    chunk = EventChunk(
        np.array([3, 639], np.uint16),
        np.array([4, 479], np.uint16),
        np.array([1, 0], np.uint8),
        np.array([1_000_000, 1_000_007], np.int64),
    )
    ours = events_header((640, 480), "stand-in") + events_packet(chunk)
    assert ours == library_bytes("events", len(ours))


@pytest.mark.realtime
def test_the_description_of_triggers_is_the_librarys() -> None:
    """The library pads the table before it by where the text ends; a reader follows offsets."""
    ours, theirs = triggers_header("stand-in"), library_bytes("triggers", 616)
    assert ours[ours.index(b"<dv") :].rstrip(b"\0") == theirs[theirs.index(b"<dv") :].rstrip(b"\0")


def serve(pipe: Any, header: bytes, packets: list[bytes]) -> None:
    """In a process of its own: the library's reader holds Python's lock while it connects."""
    server = DvServer(header)
    pipe.send(server.port)
    assert server.wait_for_client(20.0)
    for packet in packets:
        server.send(packet)
    pipe.recv()
    server.close()


@contextmanager
def reader_of(header: bytes, packets: list[bytes]) -> Iterator[Any]:
    import dv_processing as dv

    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=serve, args=(theirs, header, packets), daemon=True)
    process.start()
    try:
        assert ours.poll(60.0)
        yield dv.io.NetworkReader("127.0.0.1", ours.recv())
        ours.send("end")
        process.join(20.0)
    finally:
        process.kill()


def taken(ask: Callable[[], Any], n: int) -> list[Any]:
    found: list[Any] = []
    end = time.monotonic() + 20.0
    while sum(map(len, found)) < n:
        batch = ask()
        if batch is not None and len(batch):
            found.append(batch)
        assert time.monotonic() < end, "not all has come within 20 s"
    return found


@pytest.mark.realtime
def test_the_librarys_reader_takes_every_event() -> None:
    chunks = [chunk_of(n, seed) for seed, n in enumerate((1, 3, 100_000, 7))]
    packets = [events_packet(chunk) for chunk in chunks]
    with reader_of(events_header((640, 480), "here"), packets) as reader:

        def ask() -> Any:
            batch = reader.getNextEventBatch()
            return None if batch is None else batch.numpy()

        rows = np.concatenate(taken(ask, sum(map(len, chunks))))
        assert reader.getEventResolution() == (640, 480)
    for name, column in (("timestamp", "t_us"), ("x", "x"), ("y", "y"), ("polarity", "p")):
        expected = np.concatenate([getattr(chunk, column) for chunk in chunks])
        assert np.array_equal(rows[name], expected)


@pytest.mark.realtime
def test_the_librarys_reader_takes_every_trigger() -> None:
    import dv_processing as dv

    times = [np.sort(np.random.default_rng(n).integers(0, 1 << 50, n)) for n in (1, 2, 5, 64)]
    packets = [triggers_packet(t) for t in times]
    with reader_of(triggers_header("here"), packets) as reader:
        found = taken(reader.getNextTriggerBatch, 72)
        triggers = [(trigger.timestamp, trigger.type) for batch in found for trigger in batch]
    assert [at for at, _ in triggers] == np.concatenate(times).tolist()
    assert {kind for _, kind in triggers} == {dv.TriggerType.EXTERNAL_SIGNAL_RISING_EDGE}


def test_a_client_that_leaves_does_not_keep_the_server() -> None:
    server = DvServer(b"header")
    try:
        with socket.create_connection(("127.0.0.1", server.port), 10.0) as link:
            assert link.recv(6) == b"header"
            assert server.wait_for_client(10.0)
        for _ in range(1000):
            server.send(bytes(100_000))
        assert server.drain(10.0)
    finally:
        server.close()
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", server.port), 10.0)
