"""Broken drivers that the rules of conformance must catch.

Each is an example driver with one defect, as real drivers have had them. None can be named in a
rig file.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sliplab.plugins.driver_kit.examples import arm, events, force, frames, sync
from sliplab.plugins.driver_kit.examples.arm.driver import ExampleArm
from sliplab.plugins.driver_kit.examples.events.driver import ExampleEvents
from sliplab.plugins.driver_kit.examples.force.driver import ExampleForce
from sliplab.plugins.driver_kit.examples.frames.fake import FakedExampleFrames
from sliplab.plugins.driver_kit.examples.sync.driver import ExampleSync
from sliplab.rigs.core.capabilities import ArmState, Pose, RigError, Segment
from sliplab.rigs.core.driver import Driver
from sliplab.rigs.core.guard import Guard
from sliplab.storage.streams import ClockReads, EventChunk, PoseChunk, PulseChunk, WrenchChunk


@dataclass(frozen=True)
class Broken:
    """A broken driver, and the rules that catch it."""

    driver: Driver[Any]
    rules: tuple[str, ...]
    """All rules that it breaks; the first one is about the defect itself."""
    seen: str
    """Regular expression of the first rule's finding."""


class NewestFirst(ExampleArm):
    """Poses are returned with the newest one first."""

    def read_poses(self) -> PoseChunk:
        """Return the poses since the last call."""
        return super().read_poses()[::-1]


class ClockNotWatched(ExampleArm):
    """Times of a controller that has restarted are returned like any other."""

    def _take(self, line: str) -> None:
        self._t_ns = 0
        super()._take(line)


class StopWaits(ExampleArm):
    """Stop waits for the arm to come to rest, and sends it no command."""

    def stop(self) -> None:
        """Wait for rest, then stop."""
        while self.state() is ArmState.MOVING:
            self._rest(0.1)
        super().stop()


class StopSendsNothing(ExampleArm):
    """Stop ends the path in the driver only: the controller continues its move."""

    def stop(self) -> None:
        """Follow the path no longer."""
        self._run.cancelled = True
        self._stream.wake()


class StartWaits(ExampleArm):
    """Start waits without limit until the controller says that the arm moves."""

    def start(self, path: Sequence[Segment]) -> None:
        """Start a path, and wait for the arm to begin it."""
        super().start(path)
        while self._says is not ArmState.MOVING and not self._run.finished:
            threading.Event().wait(0.01)


class NoLimits(ExampleArm):
    """The rig's limits are left to the controller."""

    def start(self, path: Sequence[Segment]) -> None:
        """Start a path without holding it against the limits."""
        self._guard = _Lax(self._settings.limits, checked=0)
        super().start(path)


class FirstSegmentOnly(ExampleArm):
    """Only the first segment of a path is held against the limits."""

    def start(self, path: Sequence[Segment]) -> None:
        """Start a path whose first segment lies within the limits."""
        self._guard = _Lax(self._settings.limits, checked=1)
        super().start(path)


class _Lax(Guard):
    def __init__(self, limits: Any, checked: int) -> None:
        super().__init__(limits)
        self._checked = checked

    def check(self, begin: Pose, path: Sequence[Segment]) -> None:
        super().check(begin, path[: self._checked])


class AnswersShift(ExampleArm):
    """A request without an answer keeps the connection: its late answer is the next one's."""

    def _lose(self, why: str) -> None:
        if not why.startswith("no answer"):
            super()._lose(why)


class FaultsSwallowed(ExampleEvents):
    """A camera that is gone, or fails, looks like one that sees nothing."""

    def read(self) -> EventChunk:
        """Events since the last call, if any."""
        with suppress(RigError):
            return super().read()
        return EventChunk.empty()

    def read_pulses(self) -> PulseChunk:
        """Sync pulses since the last call, if any."""
        with suppress(RigError):
            return super().read_pulses()
        return PulseChunk(np.empty(0, np.int64))


class NewestPacketOnly(ExampleEvents):
    """Read returns the last packet, and loses those before it."""

    def read(self) -> EventChunk:
        """Events of the last packet."""
        return EventChunk.concatenate(self._buffer.take("events")[-1:])


class OldData(FakedExampleFrames):
    """Start keeps the frames of the run before."""

    def start(self) -> None:
        """Start grabbing."""
        with suppress(RigError):
            retained = self._buffer.take("frames")
        super().start()
        self._buffer._parts["frames"] = retained


class LeftOpen(ExampleForce):
    """Close stops the stream, but keeps thread and socket."""

    def close(self) -> None:
        """Stop the stream."""
        if self._socket is not None:
            self.stop()


class OverloadIsANumber(ExampleForce):
    """A load out of range is read as the last one that was in range."""

    def read(self) -> WrenchChunk:
        """Forces and torques since the last call."""
        try:
            return super().read()
        except RigError as error:
            if "out of range" not in str(error):
                raise
            return WrenchChunk.empty()


class OldClock(ExampleSync):
    """A late answer is taken for that of the next request."""

    def read_clock(self) -> ClockReads:
        """Read the box's clock, again where nothing came."""
        try:
            return super().read_clock()
        except RigError:
            self._buffer._fault = None
            return super().read_clock()


def arm_driver(broken: type[ExampleArm]) -> Driver[Any]:
    """Declare a broken arm."""
    return replace(arm.DRIVER, name=broken.__name__, build=broken)


def event_driver(broken: type[ExampleEvents]) -> Driver[Any]:
    """Declare a broken event camera."""
    return replace(events.DRIVER, name=broken.__name__, build=broken)


def force_driver(broken: type[ExampleForce]) -> Driver[Any]:
    """Declare a broken force sensor."""
    return replace(force.DRIVER, name=broken.__name__, build=lambda settings, arm: broken(settings))


STOP = "stop while moving"
LIMITS = "limits", "limits of turn and depth"
BROKEN = (
    Broken(
        arm_driver(NewestFirst),
        ("times in order", "poses", "host times", "counter wraps"),
        "poses: ",
    ),
    Broken(arm_driver(ClockNotWatched), ("clock falls back",), "came after"),
    Broken(arm_driver(StopWaits), (STOP, "close while moving"), "stop had not returned"),
    Broken(arm_driver(StopSendsNothing), (STOP,), "still moving when the call returned"),
    Broken(arm_driver(StartWaits), ("silent when a path starts",), "start had not returned"),
    Broken(arm_driver(NoLimits), LIMITS, "the arm moved"),
    Broken(arm_driver(FirstSegmentOnly), LIMITS, "whose second segment lies outside the box"),
    Broken(arm_driver(AnswersShift), ("late answer",), "was reported to begin|before the end"),
    Broken(
        event_driver(FaultsSwallowed),
        ("unplugged", "silent", "times fall back"),
        "did not report it",
    ),
    Broken(
        event_driver(NewestPacketOnly),
        ("data", "start while it streams", "counter wraps"),
        "were sent and",
    ),
    Broken(
        replace(frames.DRIVER, name="OldData", fake=OldData), ("fresh start",), "began with data"
    ),
    Broken(force_driver(LeftOpen), ("close",), "stayed open"),
    Broken(force_driver(OverloadIsANumber), ("overload",), "did not report it"),
    Broken(
        replace(sync.DRIVER, name="OldClock", build=OldClock),
        ("late answer",),
        "the (clock|host's times)",
    ),
)
"""Each broken driver, with the rules' findings."""
