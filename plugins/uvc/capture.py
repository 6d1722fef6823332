"""OpenCV's `VideoCapture` in a child process: a thread grabs, the process answers calls.

A grab may wait for seconds, or for ever where a driver hangs, and cannot be interrupted. In a
separate process it can be killed.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any

import cv2
import numpy as np

from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.host_clock import StallTimer
from sliplab.storage.streams import I64, U8, Json

EXPOSURE_UNIT_US = 100.0
"""Of V4L2's absolute exposure."""
MANUAL = 1.0
"""V4L2's name for an exposure that is not automatic."""
RATE_OFF, EXPOSURE_OFF = 0.01, 0.1
"""Shares by which a camera's rate and exposure may differ from those that were set."""

_NO_IMAGES: U8 = np.empty((0, 0, 0), np.uint8)


@dataclass(frozen=True)
class NewFrames:
    """Frames since the last call, and the camera's state.

    Attributes:
        images: (k, height, width). number: (k,) from 0 at the start. host_ns: (k,) arrival.
        fault: why no more frames come; None while they may.
        silent_s: since the last frame, or since the start, as far as this process could look.
        received: a frame has come since the start.
        grabbed, overflowed: since the start; overflowed frames were not read in time.
    """

    images: U8
    number: I64
    host_ns: I64
    fault: str | None
    silent_s: float
    received: bool
    grabbed: int
    overflowed: int


class Capture:
    """An open camera or stream, which grabs all the time and keeps frames from `start` to `stop`.

    Raises:
        ValueError: it cannot be opened, gives no picture, or does not take a setting.
    """

    def __init__(self, settings: UvcSettings) -> None:
        self._settings = settings
        backend = cv2.CAP_V4L2 if settings.is_camera else cv2.CAP_FFMPEG
        self._device = cv2.VideoCapture(settings.device, backend)
        if not self._device.isOpened():
            raise ValueError(f"{settings.device} cannot be opened; another program may have it")
        self.in_force = configure(self._device, settings) if settings.is_camera else {}
        good, picture = self._device.read()
        if not good:
            raise ValueError(f"{settings.device} gives no picture")
        height, width = picture.shape[:2]
        if (width, height) != (settings.width_px, settings.height_px):
            raise ValueError(
                f"{settings.device} gives {width} x {height} px, not {settings.width_px} x "
                f"{settings.height_px}: change width_px and height_px, or pixel_format"
            )
        self._lock = threading.Lock()
        self._ready: deque[tuple[U8, int, int]] = deque()
        self._region: tuple[slice, slice] | None = None
        self._run, self._grabbed, self._overflowed, self._seen = 0, 0, 0, 0
        self._fault: str | None = None
        self._stall = StallTimer()
        self._most = max(round(settings.rate_hz * settings.back_pressure_s), 2)
        threading.Thread(target=self._grab, name="frames", daemon=True).start()

    def start(self, width: int, height: int) -> None:
        """Keep frames from now on, cut to a centred region; their numbers begin at 0."""
        top, left = (
            (whole - part) // 2
            for whole, part in (
                (self._settings.height_px, height),
                (self._settings.width_px, width),
            )
        )
        with self._lock:
            self._ready.clear()
            self._region = slice(top, top + height), slice(left, left + width)
            self._run += 1
            self._grabbed = self._overflowed = 0
            self._seen += 1
            self._stall.waited_s(self._seen)

    def stop(self) -> None:
        """Store no more frames; stored ones can still be taken."""
        with self._lock:
            self._region = None

    def take(self) -> NewFrames:
        """Return the frames since the last call, and the state."""
        with self._lock:
            frames = list(self._ready)
            self._ready.clear()
            return NewFrames(
                np.stack([image for image, *_ in frames]) if frames else _NO_IMAGES,
                np.array([number for _, number, _ in frames], np.int64),
                np.array([host_ns for *_, host_ns in frames], np.int64),
                self._fault,
                self._stall.waited_s(self._seen),
                self._grabbed > 0,
                self._grabbed,
                self._overflowed,
            )

    def grabbed(self) -> int:
        """Return the number of frames since the start."""
        with self._lock:
            return self._grabbed

    def fault(self) -> str | None:
        """Return why no more frames come; None while they may."""
        with self._lock:
            return self._fault

    def _grab(self) -> None:
        """Grab for as long as frames come; runs in a thread."""
        height, width = self._settings.height_px, self._settings.width_px
        fault = (
            "it gives no more frames: unplugged, or its driver gave up; check its cable"
            if self._settings.is_camera
            else "its stream has ended"
        )
        while self._device.grab():
            now_ns = time.monotonic_ns()
            with self._lock:
                region, run = self._region, self._run
                self._seen += region is None
            if region is None:
                continue
            good, picture = self._device.retrieve()
            if not good:
                break
            if picture.shape[:2] != (height, width):
                fault = f"it changed to {picture.shape[1]} x {picture.shape[0]} px; open it again"
                break
            image = np.ascontiguousarray(_grey(picture)[region])
            with self._lock:
                self._seen += 1
                if self._run != run or self._region is None:
                    continue
                if len(self._ready) < self._most:
                    self._ready.append((image, self._grabbed, now_ns))
                else:
                    self._overflowed += 1
                self._grabbed += 1
        with self._lock:
            self._fault = fault


def configure(device: Any, settings: UvcSettings) -> Json:
    """Write every setting and read it back; return the values that the camera reports.

    Args:
        device: a `cv2.VideoCapture` on V4L2.

    Returns:
        settings by name as the rig file writes them; None for an exposure that the camera has no
        control of.

    Raises:
        ValueError: it does not take a setting.
    """
    wanted: list[tuple[str, int, float, float]] = [
        ("pixel_format", cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*settings.pixel_format), 0.0),
        ("width_px", cv2.CAP_PROP_FRAME_WIDTH, settings.width_px, 0.0),
        ("height_px", cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px, 0.0),
        ("rate_hz", cv2.CAP_PROP_FPS, settings.rate_hz, RATE_OFF * settings.rate_hz),
        ("auto_exposure", cv2.CAP_PROP_AUTO_EXPOSURE, MANUAL, 0.0),
        (
            "exposure_us",
            cv2.CAP_PROP_EXPOSURE,
            round(settings.exposure_us / EXPOSURE_UNIT_US),
            EXPOSURE_OFF * settings.exposure_us / EXPOSURE_UNIT_US,
        ),
    ]
    if settings.gain is not None:
        wanted.append(("gain", cv2.CAP_PROP_GAIN, settings.gain, 0.5))
    if settings.focus is not None:
        wanted.append(("focus", cv2.CAP_PROP_FOCUS, settings.focus, 0.5))
    # many cameras have neither; a missing control cannot be left on
    for switch in (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_AUTOFOCUS):
        device.set(switch, 0.0)
    found: Json = {}
    for name, code, value, tolerance in wanted:
        taken, back = device.set(code, value), device.get(code)
        stated = getattr(settings, name, value)
        if not taken and back < 0:  # OpenCV's answer for a missing control
            if name not in {"auto_exposure", "exposure_us"}:
                raise ValueError(f"{name} = {stated}: the camera has no such control")
            found[name] = None
            continue
        found[name] = _in_words(name, back)
        if abs(back - value) > tolerance:
            raise ValueError(f"{name} = {stated}: the camera has {found[name]} after it was set")
    return found


def _grey(picture: U8) -> U8:
    """Return a picture of OpenCV in grey levels, (height, width)."""
    if picture.ndim == 2:
        return picture
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)


def _in_words(name: str, value: float) -> Any:
    """Return a setting as the rig file writes it."""
    if name == "pixel_format":
        code = int(value)
        return "".join(chr(code >> shift & 0xFF) for shift in (0, 8, 16, 24))
    return value * EXPOSURE_UNIT_US if name == "exposure_us" else value


def serve(fd: int, settings_json: str) -> None:
    """Run the child: serve calls from the pipe on `fd` until it closes."""
    pipe = Connection(fd)
    try:
        capture = Capture(UvcSettings.model_validate_json(settings_json))
    except Exception as error:
        with suppress(OSError):
            pipe.send((False, str(error)))
        os._exit(1)
    with suppress(EOFError, OSError):
        pipe.send((True, capture.in_force))
        while True:
            name, arguments, _ = pipe.recv()
            try:
                answer = True, getattr(capture, name)(*arguments)
            except Exception as error:
                answer = False, str(error)
            pipe.send(answer)
    # a grab that hangs is left to the system, which closes the device
    os._exit(0)
