"""A free-running USB camera, read with OpenCV; its frames are timed by their arrival.

Written for Linux (V4L2) and tried on streams only: no camera was at hand. OpenCV gives neither the
number of a frame nor a time stamp that could be tied to the sync box, so a lost frame shows as too
few frames in the recorded time, and its time is known between two delays (`timing.frame_delay`).
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sliplab.plugins.uvc.capture import NewFrames
from sliplab.plugins.uvc.settings import UvcSettings
from sliplab.rigs.core.capabilities import UNKNOWN, DeviceHealth, RigError
from sliplab.rigs.core.host_clock import OR_BUSY
from sliplab.rigs.core.library_process import LibraryProcess, of_device
from sliplab.storage.streams import ClockReads, FrameChunk, Json

DEVICE = "frame camera"
OPEN_S = 20.0
"""Timeout for the process to start, to open the camera and to have its first picture, s."""
ANSWER_S = 3.0
"""Timeout of a call, s."""


class VideoStamping(NamedTuple):
    """The source of time stamps, and their grade."""

    means: str
    grade: str


def why_unreachable(settings: UvcSettings) -> str | None:
    """Return why a device cannot be opened, as far as its path says; None if it may be."""
    device = settings.device
    if not settings.is_camera:
        return None if "://" in device or Path(device).exists() else f"there is no {device}"
    try:
        kind = os.stat(device).st_mode
    except OSError as error:
        return f"{device}: {error.strerror}; plug the camera in, or name another device"
    if not stat.S_ISCHR(kind):
        return f"{device} is not a device"
    if not os.access(device, os.R_OK | os.W_OK):
        return f"{device} may not be opened: add the user to the group that owns it (video)"
    return None


class UvcCamera:
    """A `rigs.core.capabilities.FrameCamera`; opened on construction, keeping from `start` on.

    Raises:
        RigError: no such camera, it gives no picture, or it does not take a setting.
    """

    def __init__(self, settings: UvcSettings, px_per_mm: float) -> None:
        if (why := why_unreachable(settings)) is not None:
            raise RigError(DEVICE, why)
        self.settings, self.px_per_mm = settings, px_per_mm
        self.mid_exposure_ns = round(settings.exposure_us * 500)
        self.stamping = VideoStamping("host arrival", "host arrival")
        self._size = settings.width_px, settings.height_px
        self._running = False
        self._last: NewFrames | None = None
        self._fault: RigError | None = None
        self._process = of_device(
            DEVICE,
            lambda: LibraryProcess(
                "OpenCV",
                "sliplab.plugins.uvc.capture:serve",
                (settings.model_dump_json(),),
                OPEN_S,
                ignore_suspend=True,
            ),
        )
        self.in_force: Json = self._process.begun
        if self.in_force.get("exposure_us") is not None:  # the camera rounds it
            self.mid_exposure_ns = round(self.in_force["exposure_us"] * 500)

    @property
    def counts(self) -> dict[str, int]:
        """Frames of this run, or of the last one: grabbed, and dropped as not read in time."""
        if self._last is None:
            return {"grabbed": 0, "overflowed": 0}
        return {"grabbed": self._last.grabbed, "overflowed": self._last.overflowed}

    def describe(self) -> Json:
        """Return the camera's part of a trial's record: device, region, times and losses."""
        width, height = self._size
        return {
            "model": "USB camera",
            "device": self.settings.device,
            "region_px": [width, height],
            "exposure_us": self.mid_exposure_ns / 500,
            "settings": self.settings.model_dump(mode="json"),
            "in_force": self.in_force,
            "time_stamps": self.stamping.means,
            "grade": self.stamping.grade,
            "counts": self.counts,
        }

    def health(self) -> DeviceHealth:
        """Return the camera's health report, keeping or not. Raises RigError."""
        self._check()
        settings = self.settings
        return DeviceHealth(
            device=DEVICE,
            model=_model(settings.device),
            serial=UNKNOWN,
            firmware=UNKNOWN,
            temperature_c=None,
            clock=self.stamping.means,
            notes=(
                f"{settings.width_px} x {settings.height_px} px, {settings.rate_hz:g} frames/s",
                settings.device,
            ),
        )

    def set_region(self, width_px: int, height_px: int) -> None:
        """Keep only a centred region; the camera always sends its whole format.

        Raises:
            RigError: it is running, or the region exceeds the format.
        """
        settings = self.settings
        if self._running:
            raise RigError(DEVICE, "the region cannot change while grabbing; stop first")
        if not (1 <= width_px <= settings.width_px and 1 <= height_px <= settings.height_px):
            raise RigError(
                DEVICE,
                f"region {width_px} x {height_px} px: must lie within width_px x height_px = "
                f"{settings.width_px} x {settings.height_px}",
            )
        self._size = width_px, height_px

    def start(self) -> None:
        """Keep frames from now on. Raises RigError after a fault."""
        if self._fault is not None:
            raise self._fault
        self._check()
        self._call("start", *self._size)
        self._running, self._last = True, None

    def read(self) -> FrameChunk:
        """Return the frames since the last call.

        Raises:
            RigError: after a fault, once all frames before it were returned.
        """
        width, height = self._size
        images, none = np.empty((0, height, width), np.uint8), np.empty(0, np.int64)
        if self._fault is not None:
            raise self._fault
        taken: NewFrames = self._call("take")
        self._last = taken
        if not len(taken.number):
            if self._running and (why := self._why_silent(taken)) is not None:
                self._fault = RigError(DEVICE, why)
                raise self._fault
            return FrameChunk(images, none, none, none, none.astype(np.uint8))
        sync = np.zeros(len(taken.number), np.uint8)
        return FrameChunk(taken.images, taken.number, taken.host_ns, taken.host_ns, sync)

    def _why_silent(self, taken: NewFrames) -> str | None:
        if taken.fault is not None:
            return taken.fault
        limit_s = self.settings.stall_s if taken.received else self.settings.first_frame_s
        if taken.silent_s <= limit_s:
            return None
        what = "no frame" if taken.received else "no frame since the start,"
        return f"{what} for {taken.silent_s:.1f} s; check its cable{OR_BUSY}"

    def read_clock(self) -> ClockReads:
        """Not possible. Raises RigError."""
        raise RigError(DEVICE, "a USB camera has no clock that can be read")

    def stop(self) -> None:
        """Store no more frames; those received can still be read."""
        if self._running:
            self._running = False
            self._call("stop")

    def close(self) -> None:
        """End the process; safe to call more than once."""
        self._running = False
        self._process.close()

    def _check(self) -> None:
        """Raise RigError if no more frames can come."""
        fault: str | None = self._call("fault")
        if fault is not None:
            raise RigError(DEVICE, fault)

    def _call(self, name: str, *arguments: Any) -> Any:
        return of_device(DEVICE, lambda: self._process.call(name, *arguments, within_s=ANSWER_S))


def _model(device: str) -> str:
    """Return the name of a camera that the kernel knows."""
    name = Path("/sys/class/video4linux") / Path(os.path.realpath(device)).name / "name"
    try:
        return name.read_text(encoding="utf-8").strip()
    except OSError:
        return UNKNOWN
