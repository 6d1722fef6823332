"""Rows whose times fall back: they are stored, or counted, and what is counted is said."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sliplab.flows.verify import verify
from sliplab.plugins.record.recorder import record
from sliplab.plugins.record.sources import Source, columns, push
from sliplab.storage.trials.store import TrialStore
from tests.command_line import here

MS = 1_000_000
STEPS = 50
FALLS: dict[str, Callable[[int, int], int]] = {
    "not": lambda t, k: t,
    "once": lambda t, k: t - 50 * MS * (k >= 6),
    "every_other": lambda t, k: t - 50 * MS * (k % 2),
    "by_much": lambda t, k: t - 2000 * MS * (k >= 6),
    "one_row": lambda t, k: t - 50 * MS * (k == 20),
}


def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number: int = free.getsockname()[1]
        return number


def sources(link: socket.socket) -> tuple[list[Source], dict[str, Callable[[Any, int, int], None]]]:
    """Streams of every way in, and how a row of each is sent at a time."""
    places = [port(), port()]
    units = {"at": "ns", "a": "N"}
    timed: dict[str, Any] = {"time_column": "at", "time_unit": "ns"}
    image = np.zeros((4, 8), np.uint8)

    def send(number: int, data: bytes) -> None:
        link.sendto(data, ("127.0.0.1", places[number]))

    ways: dict[str, tuple[Source, Callable[[Any, int, int], None]]] = {
        "one": (push("one", {"a": "N"}), lambda trial, t, k: trial.push("one", t, k)),
        "two": (
            push("two", {"a": "N", "b": ""}, clock="own"),
            lambda trial, t, k: trial.push("two", t, k, 0),
        ),
        "ptp": (
            push("ptp", {"a": "N"}, clock="ptp", uncertainty_ms=1),
            lambda trial, t, k: trial.push("ptp", t, k),
        ),
        "events": (
            push("events", events_px=(8, 4)),
            lambda trial, t, k: trial.push("events", t // 1000, 1, 2, 0),
        ),
        "side": (
            push("side", frames_px=(8, 4)),
            lambda trial, t, k: trial.push("side", t, image),
        ),
        "lines": (
            columns("lines", f"udp://127.0.0.1:{places[0]}", units, **timed),
            lambda trial, t, k: send(0, b"%d,%d" % (t, k)),
        ),
        "packets": (
            columns("packets", f"udp://127.0.0.1:{places[1]}", units, struct="<dd", **timed),
            lambda trial, t, k: send(1, struct.pack("<dd", t, k) + b"x" * (k == 10)),
        ),
    }
    return [way[0] for way in ways.values()], {name: way[1] for name, way in ways.items()}


@pytest.mark.realtime
@pytest.mark.parametrize("fall", list(FALLS))
def test_no_row_vanishes_without_a_word(tmp_path: Path, fall: str) -> None:
    with ExitStack() as open_:
        streams, ways = sources(open_.enter_context(socket.socket(type=socket.SOCK_DGRAM)))
        recorder = open_.enter_context(record(streams, tmp_path, "rows"))
        trial = open_.enter_context(recorder.trial())
        for k in range(STEPS):
            threading.Event().wait(0.01)  # the sensors' period
            for send in ways.values():
                send(trial, FALLS[fall](time.monotonic_ns(), k), k)
    found = verify(str(tmp_path))
    assert found["ok"]
    (recording,) = TrialStore.open(tmp_path).campaign("rows").recordings()
    dropped = recording.record.imported.dropped
    rows = {name: about.rows for name, about in recording.record.streams.items()}
    rows["events"] = recording.record.counts.events
    said = {name: dropped.get(f"rows of {name} that were lost", 0) for name in ways}
    assert {name: rows[name] + said[name] for name in ways} == dict.fromkeys(ways, STEPS)
    cameras = {"events", "side"}
    assert {name for name in ways if said[name]} <= cameras | {"packets"}
    assert said["packets"] == 1  # the one with a byte too much
    assert all(bool(said[name]) == (fall != "not") for name in cameras)
    refused = {"by_much": set(ways) - cameras, "not": set()}.get(fall, {"lines", "packets"})
    bounded = {"two", "ptp"}  # which arrivals may bound, or refuse for being late
    assert refused | bounded == recording.clocks.refused.keys() | bounded
    # said by the commands too
    assert found["dropped"] == {"rows/000001": dropped}
    listed = json.loads(here("trials", tmp_path, "--json").stdout)["trials"]
    assert listed[0]["rows_lost"] == sum(dropped.values())
    assert (
        f"intact, but without {said['packets']} rows of packets"
        in " ".join(here("verify", tmp_path).stderr.split())
        or len(dropped) > 1
    )


def test_a_mark_behind_the_end_is_an_error(tmp_path: Path) -> None:
    with record([push("one", {"a": "N"})], tmp_path, "rows") as recorder:
        with recorder.trial() as trial:
            trial.push("one", None, 1.0)
        with pytest.raises(RuntimeError, match="mark 'slip': the trial has ended"):
            trial.mark("slip")
