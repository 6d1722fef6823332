"""The time of a frame: the best means that the camera has to tell it, and the grade that follows.

A camera is asked what it has and the answer is kept by name, for two cameras of one maker differ.
Meaning of the stamps, from Basler's product documentation of chunks and events: a chunk's and a
grab result's time stamp is taken when the exposure starts, that of an ExposureEnd event when it
ends. They are 64-bit counters of the camera, nanoseconds on USB; nothing wraps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from sliplab.protocols.timing import FrameGrade
from sliplab.rigs.devices.basler.settings import FrameTrigger

Means = Literal["chunk", "grab result", "exposure end event", "host arrival"]


@dataclass(frozen=True)
class Abilities:
    """Abilities of a camera that help to know a frame's time.

    Attributes:
        chunk: sends a time stamp with every frame.
        result: pylon fills `GrabResult.TimeStamp`, as far as one can tell before the first frame.
        event: sends an event with frame id and time when an exposure ends.
        latch: lets the host read its clock.
        sync_level: sends the level of the sync line with every frame, and it is wired.
        exposure_line: its ExposureActive output is wired to the sync box.
    """

    chunk: bool = False
    result: bool = False
    event: bool = False
    latch: bool = False
    sync_level: bool = False
    exposure_line: bool = False


@dataclass(frozen=True)
class Stamping:
    """The chosen means, and the grade of `protocols.timing` that it gives."""

    means: Means
    grade: FrameGrade

    def middle_ns(self, stamp_ns: int, mid_exposure_ns: int) -> int:
        """Middle of the exposure, from a stamp on the same clock, ns."""
        if self.means == "exposure end event":
            return stamp_ns - mid_exposure_ns
        return stamp_ns if self.means == "host arrival" else stamp_ns + mid_exposure_ns


def choose(has: Abilities, trigger: FrameTrigger) -> Stamping:
    """The best that a camera can do.

    Stamps of a clock that nothing ties to the sync box's are worth no more than arrivals, so then
    arrivals are what the frames say: a grade never claims what cannot be checked.
    """
    means: Means = "host arrival"
    if has.chunk:
        means = "chunk"
    elif has.result:
        means = "grab result"
    elif has.event:
        means = "exposure end event"
    if means == "host arrival":
        return Stamping(means, "host arrival")
    if trigger == "hardware" and has.sync_level:
        return Stamping(means, "hardware trigger")
    if has.exposure_line:
        return Stamping(means, "exposure line")
    if has.latch:
        return Stamping(means, "device time stamps")
    return Stamping("host arrival", "host arrival")
