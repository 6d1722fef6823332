"""Driver and pylon are real, the scene is somebody else's: every tick is a frame, or counted."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from rigs.cameras.basler import BaslerCamera, find_camera
from rigs.cameras.settings import BaslerSettings
from rigs.wire.basler import LossyDevice
from rigs.wire.live_basler import LiveBasler
from storage.streams import U8, FrameChunk

pytestmark = [pytest.mark.usefixtures("pylon_emulation"), pytest.mark.realtime]
Until = Callable[[Callable[[], bool]], None]
WIDTH, HEIGHT, PERIOD_NS = 96, 64, 10_000_000


@contextmanager
def opened(lossy: bool = False, **settings: Any) -> Iterator[tuple[BaslerCamera, Any]]:
    live: Any = LiveBasler(find_camera(None), settings.pop("clock_ns", None))
    device = LossyDevice(live) if lossy else live
    wanted = {"px_per_mm": 20.0, "exposure_us": 1000, "sync_line": 2, "stall_s": 20.0} | settings
    camera = BaslerCamera(BaslerSettings(**wanted), device)
    try:
        camera.set_region(WIDTH, HEIGHT)
        yield camera, device
    finally:
        camera.close()


def picture(number: int) -> U8:
    """Tells its number in its first bytes."""
    image = np.full((HEIGHT, WIDTH), number % 251, np.uint8)
    image[0, :8] = np.frombuffer(number.to_bytes(8, "little"), np.uint8)
    return image


def push(live: Any, count: int, begin: int = 0) -> None:
    for number in range(begin, begin + count):
        assert live.push(picture(number), (number + 1) * PERIOD_NS, 2 * (number % 3 == 0))


def test_every_tick_is_one_frame_with_its_picture_time_and_level(until: Until) -> None:
    count = 300
    with opened() as (camera, live):
        assert (camera.stamping.means, camera.stamping.grade) == ("chunk", "hardware trigger")
        assert live.region == (WIDTH, HEIGHT)
        assert not live.push(picture(0), 1)  # it does not grab yet
        camera.start()
        scene = threading.Thread(target=push, args=(live, count), daemon=True)
        scene.start()
        chunks: list[FrameChunk] = []

        def all_came() -> bool:
            chunks.append(camera.read())
            return sum(map(len, chunks)) == count

        until(all_came)
        scene.join(20.0)
        camera.stop()
    numbers = np.concatenate([chunk.number for chunk in chunks])
    assert numbers.tolist() == list(range(count))
    for chunk in chunks:
        for image, number in zip(chunk.images, chunk.number.tolist(), strict=True):
            assert np.array_equal(image, picture(number))
    t_ns = np.concatenate([chunk.t_ns for chunk in chunks])
    assert np.array_equal(t_ns, (numbers + 1) * PERIOD_NS + camera.mid_exposure_ns)
    assert np.array_equal(np.concatenate([chunk.sync for chunk in chunks]), numbers % 3 == 0)
    assert (live.frames_sent, live.unseen, live.unmatched) == (count, 1, 0)
    assert (camera.counts.grabbed, camera.counts.lost) == (count, 0)


def test_what_gets_lost_on_the_way_is_known_at_both_ends(until: Until) -> None:
    with opened(lossy=True) as (camera, device):
        camera.start()
        push(device, 5)
        until(lambda: camera.counts.grabbed == 5)
        device.drop_frames(3)
        push(device, 10, 5)
        until(lambda: camera.counts.grabbed + camera.counts.skipped == 15)
        camera.stop()
        chunk = camera.read()
        assert chunk.number.tolist() == [*range(5), *range(8, 15)]
        for image, number in zip(chunk.images, chunk.number.tolist(), strict=True):
            assert np.array_equal(image, picture(number))
        assert (device.frames_sent, device.dropped, device.unmatched) == (15, 3, 0)


def test_frames_exposed_before_the_stop_arrive_and_the_next_run_begins_anew() -> None:
    with opened() as (camera, live):
        for _ in range(2):
            camera.start()
            push(live, 20)
            camera.stop()
            assert not live.push(picture(0), 1)
            assert camera.read().number.tolist() == list(range(20))
        assert (live.frames_sent, live.unseen, live.unmatched) == (40, 2, 0)


def test_its_clock_can_be_latched() -> None:
    with opened(clock_ns=lambda: 123_456, sync_line=None, trigger="free run") as (camera, _):
        assert camera.stamping.grade == "device time stamps"
        reads = camera.read_clock()
        assert reads.device_ns.tolist() == [123_456]


def test_a_picture_of_another_size_is_refused() -> None:
    with opened() as (camera, live):
        camera.start()
        with pytest.raises(ValueError, match="instead of"):
            live.push(np.zeros((3, 3), np.uint8), 1)
