"""What a collection publishes while somebody watches, and only then."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from sliplab.flows.collecting.live_feed import (
    PICTURES,
    STATE,
    LiveFeed,
    LiveFolder,
    event_picture,
    frame_picture,
)
from sliplab.flows.planning.run_request import make_request
from sliplab.flows.running import console
from sliplab.protocols.program import Dwell
from sliplab.storage.streams import Chunk, EventChunk, FrameChunk, PulseChunk
from sliplab.storage.trials.store import TrialStore
from tests.conftest import ROOT
from tests.plugins.web.server.serving import until


def events(x: list[int], t_us: list[int]) -> EventChunk:
    """Brighter events in the diagonal."""
    place = np.array(x, np.uint16)
    return EventChunk(place, place, np.ones(len(x), np.uint8), np.array(t_us, np.int64))


def frames(image: np.ndarray) -> FrameChunk:
    """One frame."""
    one = np.zeros(1, np.int64)
    return FrameChunk(image[None], one, one, one, one.astype(np.uint8))


class Memory:
    """A sink that keeps what it gets."""

    def __init__(self) -> None:
        self.chunks: list[tuple[str, Chunk]] = []

    def add(self, device: str, chunk: Chunk) -> None:
        self.chunks.append((device, chunk))


@pytest.fixture
def feed(tmp_path: Path) -> LiveFeed:
    request = make_request(
        ROOT / "protocols" / "pilot.yaml", ROOT / "rigs" / "rehearsal.yaml", tmp_path / "store"
    )
    TrialStore.create(request.store)
    return LiveFeed(request)


def test_viewers_get_trial_phase_line_and_pictures(feed: LiveFeed, tmp_path: Path) -> None:
    live, memory = LiveFolder(tmp_path / "store"), Memory()
    trial = feed._run_request.plan.trials[3]
    image = np.full((30, 40), 128, np.uint8)
    with feed.running():
        live.watch()
        sink = feed.begin(trial, 1, memory, (64, 48))
        feed.on_step(Dwell("hold", 1.0, True))
        console.say("compiling once for this version")
        until("a viewer", lambda: feed.watched)
        sink.add("events", events([1, 2, 3], [10, 20, 30]))
        sink.add("frames", frames(image))
        sink.add("sync_box", PulseChunk(np.arange(2, dtype=np.int64)))
        pictures = json.loads(str(until("pictures", lambda: live.read(PICTURES)[1])))
        state = json.loads(live.read(STATE)[1])
    assert [name for name, _ in memory.chunks] == ["events", "frames", "sync_box"]
    assert (state["trial"], state["number"], state["attempt"]) == (trial.id, 4, 2)
    assert (state["phase"], state["campaign"]) == ("hold", "pilot")
    assert state["lines"] == ["compiling once for this version"]
    assert pictures.keys() == {"events", "frames"}
    data = np.frombuffer(base64.b64decode(pictures["frames"]), np.uint8)
    assert abs(int(cv2.imdecode(data, cv2.IMREAD_GRAYSCALE).mean()) - 128) <= 2
    assert live.read(STATE) == live.read(PICTURES) == (0, "")  # deleted with the session


def test_nothing_is_kept_while_nobody_watches(feed: LiveFeed, tmp_path: Path) -> None:
    memory = Memory()
    with feed.running():
        sink = feed.begin(feed._run_request.plan.trials[0], 0, memory, None)
        sink.add("events", events([1], [10]))
        assert feed._recent == {}
    assert len(memory.chunks) == 1
    assert not (tmp_path / "store" / ".live").exists()


def test_sinks_fault_reaches_the_trial(feed: LiveFeed) -> None:
    class Full:
        def add(self, device: str, chunk: Chunk) -> None:
            raise OSError(28, "No space left on device")

    sink = feed.begin(feed._run_request.plan.trials[0], 0, Full(), None)
    with pytest.raises(OSError, match="No space"):
        sink.add("events", events([1], [10]))


def test_event_picture_has_the_last_events_only() -> None:
    old, new = events([5], [0]), events([7, 8], [99_000, 100_000])
    picture = event_picture([old, new], (16, 12))
    assert picture.shape == (12, 16, 3)
    assert {tuple(p) for p in np.argwhere(picture.any(axis=2)).tolist()} == {(7, 7), (8, 8)}
    small = event_picture([events([639], [0])], (1280, 720))
    assert small.shape == (180, 320, 3)
    assert small[159, 159].any()


def test_frame_picture_shows_markers_of_a_camera_without_images() -> None:
    one = np.zeros(1, np.int64)
    markers = np.array([[[0, 0], [100, 50], [np.nan, np.nan]]], np.float32)
    none = np.empty((1, 0, 0), np.uint8)
    chunk = FrameChunk(none, one, one, one, one.astype(np.uint8), markers)
    assert np.count_nonzero(frame_picture(chunk)) > 50
    wide = frame_picture(frames(np.zeros((600, 800), np.uint8)))
    assert wide.shape == (300, 400)
