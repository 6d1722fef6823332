"""Time stamps of frames: the camera's best source, and the resulting grade.

The source is chosen by the camera's features, which differ between models. According to Basler's
product documentation of chunks and events, the time stamp of a chunk and of a grab result is taken
at the start of the exposure, that of an ExposureEnd event at its end. They are 64-bit counters of
the camera, in nanoseconds on USB; nothing wraps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sliplab.plugins.devices.basler.settings import FrameTrigger
from sliplab.protocols.timing import FrameGrade

Means = Literal["chunk", "grab result", "exposure end event", "host arrival"]


@dataclass(frozen=True)
class Abilities:
    """Features of a camera that determine a frame's time.

    Attributes:
        chunk: a time stamp comes with every frame.
        result: pylon fills `GrabResult.TimeStamp`, as expected before the first frame.
        event: an event with frame id and time is sent when an exposure ends.
        latch: the host can read the camera's clock.
        sync_level: the level of the sync line comes with every frame, and the line is wired.
        exposure_line: the ExposureActive output is wired to the sync box.
    """

    chunk: bool = False
    result: bool = False
    event: bool = False
    latch: bool = False
    sync_level: bool = False
    exposure_line: bool = False


@dataclass(frozen=True)
class FrameStamping:
    """The chosen source of time stamps, and the resulting grade of `protocols.timing`."""

    means: Means
    grade: FrameGrade

    def middle_ns(self, stamp_ns: int, mid_exposure_ns: int) -> int:
        """Return the middle of the exposure from a stamp on the same clock, ns."""
        if self.means == "exposure end event":
            return stamp_ns - mid_exposure_ns
        return stamp_ns if self.means == "host arrival" else stamp_ns + mid_exposure_ns


def choose(has: Abilities, trigger: FrameTrigger) -> FrameStamping:
    """Choose the best source of time stamps of a camera.

    Stamps of a clock that cannot be related to the sync box's are no better than arrival times, so
    arrival times are used then: a grade never claims more than can be verified.
    """
    means: Means = "host arrival"
    if has.chunk:
        means = "chunk"
    elif has.result:
        means = "grab result"
    elif has.event:
        means = "exposure end event"
    if means == "host arrival":
        return FrameStamping(means, "host arrival")
    if trigger == "hardware" and has.sync_level:
        return FrameStamping(means, "hardware trigger")
    if has.exposure_line:
        return FrameStamping(means, "exposure line")
    if has.latch:
        return FrameStamping(means, "device time stamps")
    return FrameStamping("host arrival", "host arrival")
