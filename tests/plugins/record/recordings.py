"""A recording whose rows say their own place, made in a process that may be killed."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from sliplab.plugins.record.recorder import RecordedTrial, record
from sliplab.plugins.record.sources import Source, push
from sliplab.storage.streams import EventChunk
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Campaign, TrialStore

SIZE = 64, 48
NAME = "killed"


def sources() -> list[Source]:
    """Numbers, events and frames."""
    return [
        push("gripper", {"width": "mm"}),
        push("events", events_px=SIZE),
        push("side", frames_px=SIZE),
    ]


def feed(trial: RecordedTrial, index: int) -> None:
    """Push the rows of one step: 100 numbers, 2,000 events and a frame."""
    now = time.monotonic_ns()
    trial.push("gripper", now + np.arange(100), index * 100.0 + np.arange(100))
    events = event_rows(index * 2000, 2000)
    trial.push("events", now // 1000 + np.arange(2000) // 200, events.x, events.y, events.p)
    trial.push("side", now, np.full(SIZE[::-1], index % 256, np.uint8))


def event_rows(first: int, count: int) -> EventChunk:
    """Events by their place in the stream."""
    places = np.arange(first, first + count)
    x, y, p = places % SIZE[0], places // SIZE[0] % SIZE[1], places % 2
    return EventChunk(*(a.astype(t) for a, t in ((x, "u2"), (y, "u2"), (p, "u1"))), places)


def record_for_ever(folder: Path) -> None:
    """Record short trials until killed."""
    with record(sources(), folder, NAME) as recorder:
        while True:
            with recorder.trial(object="mug") as trial:
                until, index = time.monotonic() + 1.2, 0
                while time.monotonic() < until:
                    feed(trial, index)
                    index += 1
                    time.sleep(0.004)  # a source of some rate


@contextmanager
def forked(work: Callable[[], None]) -> Iterator[int]:
    """Run something in a copy of this process, which is killed when the block ends."""
    child = os.fork()
    if child == 0:
        try:
            work()
        except BaseException:
            traceback.print_exc()
        os._exit(1)
    try:
        yield child
    finally:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)


def campaign_of(folder: Path) -> Campaign:
    """The campaign of a folder's store."""
    return TrialStore.open(folder).campaign(NAME)


def check_rows(recording: Recording) -> None:
    """See that a trial has the beginning of what was pushed, and nothing else."""
    with recording.open() as reader:
        widths = reader.column("streams/gripper/value")
        events = reader.events()
    np.testing.assert_array_equal(widths, np.arange(len(widths)))
    expected = event_rows(0, len(events))
    for name in "xyp":
        np.testing.assert_array_equal(getattr(events, name), getattr(expected, name))
    if recording.record.streams["side"].rows:
        for index, image in enumerate(recording.frames(stream="side")):
            assert (image == index % 256).all()
