"""Frames of a scene through pylon's emulated camera and the driver: the same ones, or a gap."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sliplab.plugins.devices.basler.driver import BaslerCamera
from sliplab.plugins.devices.basler.fake_live import LiveBasler
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.capabilities import RigError
from sliplab.storage.streams import FrameChunk
from tests.patching import put
from tests.rigs.waiting import gather, until

pytestmark = pytest.mark.realtime

WIDTH, HEIGHT, MID_NS, PERIOD_NS = 64, 48, 1_000_000, 10_000_000
ARRIVE_S = 10.0


class FakeScene:
    """A scene that shows what it is told to, when it is told to."""

    def __init__(self) -> None:
        self.on_frames: Callable[[FrameChunk], None] = lambda frames: None
        self.grabbed: list[tuple[int, int]] = []
        self.stops = 0
        self.last: FrameChunk | None = None

    def grab(self, width_px: int, height_px: int, on_frames: Callable[[FrameChunk], None]) -> None:
        self.on_frames = on_frames
        self.grabbed.append((width_px, height_px))

    def stop_grabbing(self) -> None:
        self.stops += 1
        if self.last is not None:  # exposed before the stop
            self.on_frames(self.last)
        self.on_frames(frames(0, 0))


def frames(first: int, count: int) -> FrameChunk:
    """Frames with these numbers, each unlike the others."""
    number = np.arange(first, first + count, dtype=np.int64)
    images = np.random.default_rng(1).integers(0, 256, (count, HEIGHT, WIDTH)).astype(np.uint8)
    t_ns = 5_000_000_000 + number * PERIOD_NS + MID_NS
    return FrameChunk(images, number, t_ns, t_ns, (number % 3 == 0).astype(np.uint8))


@pytest.fixture
def scene() -> FakeScene:
    return FakeScene()


@pytest.fixture
def camera(scene: FakeScene) -> Iterator[BaslerCamera]:
    device = LiveBasler(scene, MID_NS, 2)
    settings = BaslerSettings(trigger="hardware", trigger_line="Line1", sync_line=2)
    camera = BaslerCamera(settings.model_copy(update={"px_per_mm": 10.0}), device)
    camera.set_region(WIDTH, HEIGHT)
    yield camera
    camera.close()


def test_pictures_numbers_times_and_levels_are_the_scenes(scene: FakeScene, camera: Any) -> None:
    assert camera.stamping.grade == "hardware trigger"
    camera.start()
    assert scene.grabbed == [(WIDTH, HEIGHT)]
    sent = frames(0, 12)
    scene.on_frames(sent)
    got = gather(camera.read, 12)
    assert np.array_equal(got.images, sent.images)
    assert got.number.tolist() == sent.number.tolist()
    assert got.t_ns.tolist() == sent.t_ns.tolist()
    assert got.sync.tolist() == sent.sync.tolist()
    assert (camera.counts.grabbed, camera.counts.lost) == (12, 0)
    camera.stop()
    assert scene.stops == 1


def test_what_was_exposed_before_the_stop_can_be_read_after_it(scene: Any, camera: Any) -> None:
    camera.start()
    scene.on_frames(frames(0, 3))
    gather(camera.read, 3)
    scene.last = frames(3, 9)
    camera.stop()
    assert gather(camera.read, 9).number.tolist() == list(range(3, 12))
    assert camera.counts.lost == 0


def test_every_run_counts_from_0(scene: FakeScene, camera: BaslerCamera) -> None:
    for _ in range(2):
        camera.start()
        scene.on_frames(frames(0, 4))
        assert gather(camera.read, 4).number.tolist() == [0, 1, 2, 3]
        camera.stop()


def test_dropped_frames_are_a_gap_in_the_numbers(scene: FakeScene, camera: BaslerCamera) -> None:
    camera.start()
    scene.on_frames(frames(0, 2))
    gather(camera.read, 2)
    camera.device.drop_frames(3)
    scene.on_frames(frames(2, 6))
    assert gather(camera.read, 3).number.tolist() == [5, 6, 7]
    assert camera.counts.lost == camera.counts.skipped == 3


def test_a_clock_that_falls_back_is_a_fault(scene: FakeScene, camera: BaslerCamera) -> None:
    camera.start()
    scene.on_frames(frames(0, 3))
    gather(camera.read, 3)
    later = frames(3, 3)
    scene.on_frames(replace(later, t_ns=later.t_ns - 2_000_000_000))
    with pytest.raises(RigError, match=r"its clock jumped back by 1\.990 s"):
        until(lambda: bool(len(camera.read())), ARRIVE_S)


def test_an_unplugged_camera_is_noticed_with_what_to_do(scene: FakeScene, camera: Any) -> None:
    camera.start()
    scene.on_frames(frames(0, 2))
    gather(camera.read, 2)
    camera.device.unplug()

    with pytest.raises(RigError, match="unplugged; plug it in and open it again"):
        until(lambda: bool(camera.read().number.size > 100), 3.0)
    with pytest.raises(RigError, match="unplugged"):
        camera.health()


def test_a_scene_that_is_gone_does_not_keep_the_camera_from_stopping(
    scene: FakeScene, camera: BaslerCamera
) -> None:
    camera.start()

    def gone() -> None:
        raise RigError("stand-ins", "have ended")

    put(scene, "stop_grabbing", gone)
    camera.stop()
    assert not camera.device.IsGrabbing()
