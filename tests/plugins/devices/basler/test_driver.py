"""The real pylon against its own emulated camera: sizes, order and counts, never rates."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.basler_emulation import (
    LossyDevice,
    fail_buffers,
    scene_frames,
    show,
    unplug,
    write_frames,
)
from sliplab.plugins.devices.basler.driver import BaslerCamera, find_camera
from sliplab.plugins.devices.basler.settings import BaslerSettings
from sliplab.rigs.core.capabilities import FrameCamera, RigError
from sliplab.storage.streams import FrameChunk
from tests.rigs.waiting import gather, until

pytestmark = [pytest.mark.usefixtures("pylon_emulation"), pytest.mark.realtime]
FREE: dict[str, Any] = {"trigger": "free run", "px_per_mm": 20.0}
PATIENT: dict[str, Any] = {"back_pressure_s": 1.0, "first_frame_s": 30.0, "stall_s": 20.0}
"""Few buffers, for each costs time before the first frame, and limits for a busy computer."""
WIRED = FREE | {"exposure_line": "Line2"}


@contextmanager
def opened(lossy: bool = False, **settings: Any) -> Iterator[BaslerCamera]:
    device = LossyDevice(find_camera(None)) if lossy else None
    camera = BaslerCamera(BaslerSettings(**PATIENT | settings), device)
    try:
        camera.set_region(64, 48)
        yield camera
    finally:
        camera.close()


def test_it_can_do_what_a_frame_camera_must() -> None:
    with opened(**FREE, exposure_us=3000) as camera:
        assert isinstance(camera, FrameCamera)
        assert camera.mid_exposure_ns == 1_500_000
        assert camera.px_per_mm == 20.0
        assert camera.read().images.shape == (0, 48, 64)
        camera.start()
        first = gather(camera.read, 3)
        assert first.images.dtype == np.uint8
        assert first.images.shape[1:] == (48, 64)
        assert first.number[0] == 0


def test_the_region_is_in_the_middle_and_must_fit() -> None:
    with opened(**FREE) as camera:
        camera.set_region(1000, 1000)
        nodes = camera.device
        assert (nodes.OffsetX.Value, nodes.OffsetY.Value) == (1548, 1548)  # of 4096 x 4096
        with pytest.raises(RigError, match="width of 5000 px"):
            camera.set_region(5000, 48)
        camera.start()
        with pytest.raises(RigError, match="stop first"):
            camera.set_region(64, 48)


def test_pictures_are_those_of_the_scene_in_order(tmp_path: Path) -> None:
    images = scene_frames(8, 64, 48)
    write_frames(tmp_path / "frames", images)
    with opened(**FREE) as camera:
        show(camera.device, tmp_path / "frames")
        camera.start()
        chunk = gather(camera.read, 16)
    assert np.array_equal(chunk.images, images[chunk.number % 8])


def test_every_software_trigger_gives_one_frame() -> None:
    with opened(trigger="software", px_per_mm=20.0) as camera:
        camera.start()
        for number in range(5):
            camera.trigger()
            assert gather(camera.read, 1).number.tolist() == [number]
        camera.stop()
        assert len(camera.read()) == 0
        assert (camera.counts.grabbed, camera.counts.lost) == (5, 0)


def test_under_load_none_is_missing_and_order_holds() -> None:
    with opened(**FREE, rate_hz=500, exposure_us=100) as camera:
        camera.set_region(1000, 1000)
        camera.start()
        chunk = gather(camera.read, 150)
        camera.stop()
        chunk = FrameChunk.concatenate([chunk, camera.read()])
        numbers = chunk.number.tolist()
        assert numbers == list(range(len(numbers)))
        assert camera.counts.grabbed == len(numbers)
        assert camera.counts.lost == 0
        assert np.all(np.diff(chunk.host_ns) >= 0)


def test_a_reader_that_sleeps_loses_nothing_while_there_are_buffers() -> None:
    with opened(**FREE, rate_hz=100, back_pressure_s=1.0) as camera:
        camera.start()
        until(lambda: camera.counts.grabbed >= 50)  # the queue is full
        until(lambda: camera.device.NumReadyBuffers.Value >= 5)  # and now pylon waits
        numbers = gather(camera.read, 60).number.tolist()
        assert numbers == list(range(len(numbers)))
        assert camera.counts.lost == 0


def test_times_come_from_exposure_ends_where_a_wire_ties_them_down() -> None:
    with opened(**WIRED, exposure_us=2000) as camera:
        assert (camera.stamping.means, camera.stamping.grade) == (
            "exposure end event",
            "exposure line",
        )
        camera.start()
        chunk = gather(camera.read, 20)
        camera.stop()
        assert np.all(np.diff(chunk.t_ns) > 0)
        # pylon's emulation stamps with the host's clock: the middle lies half an exposure back
        assert np.all(chunk.t_ns + camera.mid_exposure_ns <= chunk.host_ns)
        assert camera.counts.unstamped == 0
        assert camera.describe()["time_stamps"] == "exposure end event"


def test_a_clock_that_nothing_ties_down_is_not_used() -> None:
    with opened(**FREE) as camera:
        assert camera.stamping.grade == camera.describe()["grade"] == "host arrival"
        with pytest.raises(RigError, match="no clock"):
            camera.read_clock()
        camera.start()
        chunk = gather(camera.read, 3)
        assert np.array_equal(chunk.t_ns, chunk.host_ns)


def test_failed_buffers_are_counted_and_leave_a_gap() -> None:
    with opened(**FREE) as camera:
        camera.start()
        numbers = gather(camera.read, 5).number.tolist()
        fail_buffers(camera.device, 3)
        until(lambda: camera.counts.failed == 3)
        numbers += gather(camera.read, 5).number.tolist()
        gone = sorted(set(range(numbers[-1] + 1)) - set(numbers))
        assert len(gone) == 3
        assert gone == list(range(gone[0], gone[0] + 3))
        assert (camera.counts.skipped, camera.counts.lost) == (0, 3)


def test_skipped_frames_are_counted_and_leave_a_gap() -> None:
    with opened(lossy=True, **WIRED) as camera:
        camera.start()
        numbers = gather(camera.read, 5).number.tolist()
        camera.device.drop_frames(4)
        until(lambda: camera.counts.skipped == 4)
        numbers += gather(camera.read, 5).number.tolist()
        assert len(set(range(numbers[-1] + 1)) - set(numbers)) == 4
        assert (camera.counts.failed, camera.counts.lost) == (0, 4)


def test_an_unplugged_camera_is_an_error_after_what_it_gave() -> None:
    with opened(**FREE) as camera:
        camera.start()
        gather(camera.read, 3)
        unplug(camera.device)
        with pytest.raises(RigError, match="unplugged"):
            until(lambda: camera.read() is None)
        camera.stop()
        with pytest.raises(RigError):
            camera.start()


def test_a_silent_camera_is_an_error_within_the_stated_time() -> None:
    with opened(lossy=True, **FREE, stall_s=1.0) as camera:
        camera.start()
        gather(camera.read, 3)
        camera.device.fall_silent()
        with pytest.raises(RigError, match=r"no frame for \d\.\d s.* is too busy"):
            until(lambda: camera.read() is None)
        camera.stop()


def test_before_the_first_frame_silence_has_a_limit_of_its_own() -> None:
    with opened(lossy=True, **FREE, first_frame_s=0.3) as camera:
        camera.device.fall_silent()
        camera.start()
        with pytest.raises(RigError, match=r"no frame since the start, for \d\.\d s"):
            until(lambda: camera.read() is None)


def test_a_camera_that_is_not_there_is_named() -> None:
    with pytest.raises(RigError, match="serial number 4711; found: 0815"):
        BaslerCamera(BaslerSettings(px_per_mm=20.0, serial="4711"))


def test_a_line_trigger_can_be_set_and_then_nothing_comes_by_itself() -> None:
    with opened(px_per_mm=20.0, trigger="hardware", stall_s=0.2) as camera:
        assert camera.device.TriggerSource.Value == "Line1"
        camera.start()
        assert len(camera.read()) == 0
        camera.stop()
        assert camera.counts.grabbed == 0


def test_a_closed_camera_gives_its_descriptors_back_though_an_error_keeps_it() -> None:
    def descriptors() -> int:
        return len(list(Path("/proc/self/fd").iterdir()))

    BaslerCamera(BaslerSettings(**FREE)).close()  # what pylon opens once and keeps
    before = descriptors()
    kept: list[RigError] = []
    for _ in range(3):
        camera = BaslerCamera(BaslerSettings(**FREE))
        camera.start()
        with pytest.raises(RigError, match="already grabbing") as refused:
            camera.start()
        kept.append(refused.value)  # its traceback refers to the camera
        camera.close()
    assert descriptors() <= before + 2
    with pytest.raises(RigError, match="is closed; open it again"):
        camera.health()
