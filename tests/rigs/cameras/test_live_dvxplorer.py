"""The real dv-processing, and a camera that is fed while it runs: counts at both ends."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from rigs.cameras.dvxplorer import DvxplorerCamera
from rigs.wire.dvxplorer import ServerError
from rigs.wire.live_dvxplorer import LiveDvxplorer
from storage.streams import EventChunk, PulseChunk

pytestmark = pytest.mark.realtime
Until = Callable[[Callable[[], bool]], None]


def block(number: int, count: int = 1000) -> tuple[EventChunk, PulseChunk]:
    """Events of 10 ms and two pulses; those of block k begin at 10 k ms."""
    rng = np.random.default_rng(number)
    begin = number * 10_000
    chunk = EventChunk(
        rng.integers(0, 640, count).astype(np.uint16),
        rng.integers(0, 480, count).astype(np.uint16),
        rng.integers(0, 2, count).astype(np.uint8),
        begin + np.sort(rng.integers(0, 10_000, count)),
    )
    return chunk, PulseChunk(np.array([begin, begin + 5_000]) * 1000)


def test_what_is_sent_while_it_runs_arrives_whole(until: Until) -> None:
    blocks = [block(number) for number in range(100)]
    with LiveDvxplorer() as live:
        camera = DvxplorerCamera(live.settings.model_copy(update={"stall_s": 30.0}))
        try:
            until(lambda: live.heard)
            camera.start()
            chunks, pulses = [], []
            for sent in blocks:
                live.send(*sent)
                chunks.append(camera.read())
                pulses.append(camera.read_pulses().t_ns)
            live.settle(30.0)
            assert (live.events_sent, live.triggers_sent, live.unheard) == (100_000, 200, 0)
            assert (live.events_given, live.pulses_given) == (100_000, 200)
            until(lambda: (camera.counts.events, camera.counts.pulses) == (100_000, 200))
            chunks.append(camera.read())
            pulses.append(camera.read_pulses().t_ns)
            camera.stop()
        finally:
            camera.close()
    for name in ("x", "y", "p", "t_us"):
        came = np.concatenate([getattr(chunk, name) for chunk in chunks])
        given = np.concatenate([getattr(chunk, name) for chunk, _ in blocks])
        assert np.array_equal(came, given)
    assert np.array_equal(np.concatenate(pulses), np.concatenate([each.t_ns for _, each in blocks]))


def test_what_nobody_hears_is_counted() -> None:
    with LiveDvxplorer() as live:
        live.send(*block(0, 7))
        live.settle(30.0)
        assert not live.heard
        assert (live.events_sent, live.triggers_sent, live.unheard) == (0, 0, 9)


def test_a_process_that_has_ended_is_an_error() -> None:
    live = LiveDvxplorer()
    live.close()
    with pytest.raises(ServerError, match="ended"):
        live.send(*block(0))
    live._given += 1  # as if one were on its way
    with pytest.raises(ServerError, match="have not left"):
        live.settle(30.0)
