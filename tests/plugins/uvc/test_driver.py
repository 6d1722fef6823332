"""The USB camera's driver: OpenCV in its process, on streams; settings on a pretended camera.

What a rig needs of it is tried by the rules of conformance: tests/plugins/driver_kit.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from sliplab.plugins.uvc.capture import Capture, configure
from sliplab.plugins.uvc.device import DRIVER
from sliplab.plugins.uvc.driver import UvcCamera
from sliplab.plugins.uvc.fake import VideoPipe
from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.capabilities import FrameCamera, RigError
from sliplab.rigs.core.registry import find_driver
from tests.rigs.waiting import until

SMALL: dict[str, Any] = {"width_px": 64, "height_px": 48}


def video(path: Path, frames: int) -> np.ndarray:
    """A file with random pictures, uncompressed."""
    images = np.random.default_rng(7).integers(0, 256, (frames, 48, 64)).astype(np.uint8)
    with av.open(str(path), "w", format="avi") as container:
        stream = container.add_stream("rawvideo", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "bgr24"
        for image in images:
            whole = np.repeat(image[..., None], 3, axis=2)
            for packet in stream.encode(av.VideoFrame.from_ndarray(whole, format="bgr24")):
                container.mux(packet)
    return images


def test_it_is_found_by_its_name_and_its_settings_are_held_against_each_other() -> None:
    assert find_driver("uvc", type(DRIVER)) is DRIVER
    with pytest.raises(ValidationError, match="period of rate_hz = 60"):
        UvcSettings(rate_hz=60, exposure_us=20_000)
    with pytest.raises(ValueError, match="pixel_format"):
        UvcSettings(pixel_format="RGB3")


class Pretended:
    """A `VideoCapture` that keeps some values whatever is written, and lacks some controls."""

    def __init__(self, keeps: dict[int, float], lacks: tuple[int, ...]) -> None:
        self.values, self._keeps, self._lacks = dict[int, float](), keeps, lacks

    def set(self, code: int, value: float) -> bool:
        if code in self._lacks:
            return False
        self.values[code] = self._keeps.get(code, value)
        return True

    def get(self, code: int) -> float:
        return self.values.get(code, -1.0)


def configured(
    keeps: dict[int, float], lacks: tuple[int, ...] = (), **settings: Any
) -> tuple[dict[str, Any], Pretended]:
    """Configure a pretended camera; return what is in force."""
    device = Pretended(keeps, lacks)
    return configure(device, UvcSettings(**settings)), device


def test_settings_are_written_read_back_and_kept_as_the_camera_has_them() -> None:
    found, device = configured({cv2.CAP_PROP_EXPOSURE: 49.0}, exposure_us=5000, gain=12)
    said = {"pixel_format": "MJPG", "width_px": 1280, "height_px": 720, "rate_hz": 30.0}
    assert found == {**said, "auto_exposure": 1.0, "exposure_us": 4900.0, "gain": 12.0}
    assert device.values[cv2.CAP_PROP_AUTO_WB] == device.values[cv2.CAP_PROP_AUTOFOCUS] == 0.0


def test_a_camera_without_a_control_of_its_exposure_says_so() -> None:
    """As v4l2loopback: it has formats and no controls. What somebody asked for is refused."""
    lacks = (cv2.CAP_PROP_AUTO_EXPOSURE, cv2.CAP_PROP_EXPOSURE, cv2.CAP_PROP_GAIN)
    found, _ = configured({}, lacks)
    assert (found["auto_exposure"], found["exposure_us"]) == (None, None)
    with pytest.raises(ValueError, match=r"gain = 3.0: the camera has no such control"):
        configured({}, lacks, gain=3)


YUYV = float(cv2.VideoWriter.fourcc(*"YUYV"))


@pytest.mark.parametrize(
    ("code", "kept", "message"),
    [
        (cv2.CAP_PROP_FRAME_WIDTH, 640.0, "width_px = 1280: the camera has 640"),
        (cv2.CAP_PROP_FPS, 15.0, "rate_hz = 30.0: the camera has 15"),
        (cv2.CAP_PROP_AUTO_EXPOSURE, 3.0, "auto_exposure = 1.0: the camera has 3"),
        (cv2.CAP_PROP_EXPOSURE, 156.0, "exposure_us = 5000.0: the camera has 15600"),
        (cv2.CAP_PROP_FOURCC, YUYV, "pixel_format = MJPG: the camera has YUYV"),
    ],
)
def test_a_setting_that_is_not_taken_is_refused(code: int, kept: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        configured({code: kept})


def test_a_path_that_cannot_be_a_camera_is_named(tmp_path: Path) -> None:
    def unreachable(device: str) -> str | None:
        return DRIVER.ping(UvcSettings(device=device))

    assert unreachable("/dev/null") is None
    assert "No such file" in str(unreachable("/dev/video-none"))
    assert "is not a device" in str(unreachable("/dev/shm"))
    assert "there is no" in str(unreachable(str(tmp_path / "none.avi")))
    assert unreachable("http://127.0.0.1:1/stream") is None
    with pytest.raises(RigError, match="cannot be opened"):
        UvcCamera(UvcSettings(device="/dev/null"), 10.0)


def test_a_stream_of_another_format_is_refused(tmp_path: Path) -> None:
    video(tmp_path / "a.avi", 3)
    with pytest.raises(RigError, match="gives 64 x 48 px, not 1280 x 720"):
        UvcCamera(UvcSettings(device=str(tmp_path / "a.avi")), 10.0)


@pytest.fixture
def pipe() -> Iterator[VideoPipe]:
    made = VideoPipe(64, 48, 30.0)
    yield made
    made.close()


@pytest.mark.realtime
def test_pictures_come_unchanged_cut_to_the_region_and_in_order(pipe: Any) -> None:
    images = np.random.default_rng(7).integers(0, 256, (20, 48, 64)).astype(np.uint8)
    camera = UvcCamera(UvcSettings(device=pipe.path, back_pressure_s=0.2, **SMALL), 10.0)
    try:
        assert isinstance(camera, FrameCamera)
        assert camera.stamping.grade == "host arrival"
        assert camera.mid_exposure_ns == 2_500_000
        with pytest.raises(RigError, match="must lie within"):
            camera.set_region(65, 48)
        camera.set_region(32, 16)
        with pytest.raises(RigError, match="no clock"):
            camera.read_clock()
        assert len(camera.read()) == 0
        before_ns = time.monotonic_ns()
        camera.start()
        with pytest.raises(RigError, match="stop first"):
            camera.set_region(64, 48)
        for image in images:
            pipe.show(image)
        until(lambda: camera._call("grabbed") == 20)
        chunk = camera.read()
        # nobody read: the buffer of 0.2 s holds six, and what did not fit is counted
        assert chunk.number.tolist() == list(range(6))
        assert (chunk.images == images[:6, 16:32, 16:48]).all()
        assert camera.counts == {"grabbed": 20, "overflowed": 14}
        assert (chunk.t_ns == chunk.host_ns).all()
        assert before_ns < chunk.host_ns[0]
        assert (np.diff(chunk.host_ns) >= 0).all()
        assert camera.health().clock == "host arrival"
        assert camera.describe()["counts"]["overflowed"] == 14
    finally:
        camera.close()


class Changing:
    """A `VideoCapture` whose pictures change their size after the first ones."""

    def __init__(self, pictures: list[np.ndarray]) -> None:
        self.pictures, self.begun = pictures, threading.Event()

    def isOpened(self) -> bool:
        return True

    def grab(self) -> bool:
        return self.begun.wait(10.0) and bool(self.pictures)

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, self.pictures.pop(0)

    def read(self) -> tuple[bool, np.ndarray]:
        return self.retrieve()


def test_pictures_of_another_size_are_a_fault(monkeypatch: Any) -> None:
    right, wrong = np.zeros((48, 64, 3), np.uint8), np.zeros((24, 64, 3), np.uint8)
    device = Changing([right, right, right, wrong])
    monkeypatch.setattr(cv2, "VideoCapture", lambda *_: device)
    found = Capture(UvcSettings(device="http://127.0.0.1:1/stream", **SMALL))
    found.start(64, 48)
    device.begun.set()
    until(lambda: found.fault() is not None)
    assert found.fault() == "it changed to 64 x 24 px; open it again"
    assert found.take().images.shape == (2, 48, 64)


@pytest.mark.realtime
def test_an_ended_stream_and_a_killed_process_are_faults(pipe: VideoPipe) -> None:
    camera = UvcCamera(UvcSettings(device=pipe.path, **SMALL), 10.0)
    try:
        camera.start()
        pipe.show(np.zeros((48, 64), np.uint8))
        until(lambda: len(camera.read()) == 1)
        pipe.close()

        until(lambda: camera._call("fault") is not None)
        with pytest.raises(RigError, match="its stream has ended"):
            camera.read()
        with pytest.raises(RigError, match="ended"):
            camera.start()
        with pytest.raises(RigError, match="ended"):
            camera.health()
        camera._process.kill()
        with pytest.raises(RigError, match="OpenCV"):
            camera.health()
    finally:
        camera.close()
