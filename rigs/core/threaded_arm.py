"""The common part of the drivers of real arms: a thread follows a path and notes its progress.

A driver brings its own connection, its own way to send a path and its own ways to stop. What it
says of a path while it runs, and what becomes of one that fails, is the same for all.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

from sliplab.rigs.core.arm_settings import Limits
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Progress, RigError, Segment
from sliplab.rigs.core.guard import Guard
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.rigs.core.pose_stream import PoseStream
from sliplab.storage.streams import PoseChunk, PulseChunk

LEFT_MM = 0.001
"""A segment has begun once the tool centre point is this far from where it stood."""
NEAR_MM = 0.05
"""Largest distance from its target at which a segment may end."""
REST_SHARE = 0.02
"""Below this share of its speed, near its target, a segment has ended."""
_LEFT_DEG, _NEAR_DEG = 0.001, 0.1


@dataclass
class Run:
    """A path that was started; before the first one there is an empty one that is done."""

    path: Sequence[Segment]
    finished: list[tuple[int, int]] = field(default_factory=list)
    """Start and end of finished segments, controller clock in ns."""
    done: bool = False
    cancelled: bool = False
    """Somebody asked for a stop."""
    error: ArmFault | None = None
    """Reason for which the path was given up, where the arm's state does not show it."""
    thread: threading.Thread | None = None

    def progress(self, state: ArmState) -> Progress:
        """Return how far it has come.

        Raises:
            ArmFault: it was given up for a reason that `state` does not say: the arm is healthy, or
                its program was ended because of that reason.
        """
        if self.error is not None and (state.healthy or state is ArmState.NOT_RUNNING):
            raise self.error
        return Progress(state, tuple(self.finished), self.done)

    def join(self, within_s: float) -> None:
        """Wait for its thread to end, unless that thread itself asks."""
        if self.thread is not None and self.thread is not threading.current_thread():
            self.thread.join(within_s)


class ThreadedArm(ABC):
    """A base for drivers of arms that follow a path in a thread of their own.

    A subclass has `state`, and follows a path in `_follow_path` and gives one up in
    `_give_up`.
    """

    def __init__(self, limits: Limits) -> None:
        self._guard = Guard(limits)
        self._stream = PoseStream()
        self._lost: str | None = "not connected"
        """Reason for which the arm cannot be reached; None while it can."""
        self._run = Run((), done=True)

    @abstractmethod
    def state(self) -> ArmState:
        """Return the arm's state; never waits."""

    def progress(self) -> Progress:
        """Return how far the path has come.

        Raises:
            ArmFault: the path was given up for a reason that `state` does not tell.
        """
        return self._run.progress(self.state())

    def read_poses(self) -> PoseChunk:
        """Return the measured poses since the last call."""
        return self._stream.read()

    def read_pulses(self) -> PulseChunk:
        """Return the rising edges of the sync input since the last call."""
        return self._stream.read_pulses()

    def _begin(self, run: Run) -> None:
        """Follow a path from now on, in a thread of its own."""
        run.thread = threading.Thread(target=self._follow, args=(run,), daemon=True)
        run.thread.start()

    def _follow(self, run: Run) -> None:
        """A path's thread; one that dies must not look like a stop from outside."""
        try:
            self._follow_path(run)
        except Exception as error:
            given_up = ArmFault("arm", f"its path was given up: {error!r}")
            run.error = error if isinstance(error, ArmFault) else given_up
            self._give_up()
        finally:
            run.done = True
            self._path_is_over()

    @abstractmethod
    def _follow_path(self, run: Run) -> None:
        """Wait for each segment to end, and note it in `run.finished`. May raise anything."""

    @abstractmethod
    def _give_up(self) -> None:
        """Stop what nobody follows any more."""

    def _path_is_over(self) -> None:
        """Wake whoever waits for poses: the path's thread has come to its end."""
        self._stream.wake()

    def _refuse(self, path: Sequence[Segment], moving: bool) -> None:
        """Raise RigError for an empty path, or for one that comes too early."""
        if not path:
            raise RigError("arm", "was given an empty path")
        if moving:
            raise RigError("arm", "is still moving; wait for its path to end, or stop it")

    def _fault(self, state: ArmState, what: str) -> ArmFault:
        reason = f" ({self._lost})" if state is ArmState.DISCONNECTED and self._lost else ""
        return ArmFault("arm", f"{what}: {state.value}{reason}; {state.advice}")


class SegmentWatch:
    """Tells when each segment of a path began and ended, from the pose stream alone.

    For controllers that do not say so themselves: commanded poses are exact, so leaving a place and
    coming to rest at another one can be seen to a sample.

    Args:
        begin: where the arm stands.
        path: its segments, each from rest to rest.
    """

    def __init__(self, begin: Pose, path: Sequence[Segment]) -> None:
        self._begin, self._path = begin, path
        self._start_ns: int | None = None
        self._before: tuple[int, Pose] | None = None
        self._count = 0

    @property
    def done(self) -> bool:
        """True once every segment has ended."""
        return self._count == len(self._path)

    @property
    def begun(self) -> bool:
        """True once the arm has left the start of the path."""
        return self._count > 0 or self._start_ns is not None

    def see(self, t_ns: int, pose: Pose) -> tuple[int, int] | None:
        """Take one sample; start and end of the segment that has ended with it, if one has."""
        before, self._before = self._before, (t_ns, pose)
        if self.done or before is None or t_ns <= before[0]:
            return None
        if self._start_ns is None and not has_left(self._begin, pose):
            return None
        if self._start_ns is None:
            self._start_ns = before[0]
        segment = self._path[self._count]
        speed = distance_mm(before[1], pose) / (t_ns - before[0]) * 1e9
        if not is_at(pose, segment.to) or speed > REST_SHARE * segment.speed_mm_s:
            return None
        times = self._start_ns, t_ns
        self._begin, self._start_ns = pose, None
        self._count += 1
        return times


def is_at(pose: Pose, target: Pose) -> bool:
    """Return whether a pose is as close to a target as a segment that has ended."""
    return distance_mm(pose, target) <= NEAR_MM and angle_deg(pose, target) <= _NEAR_DEG


def has_left(begin: Pose, pose: Pose) -> bool:
    """Return whether a pose is another one than where the arm stood."""
    return distance_mm(begin, pose) > LEFT_MM or angle_deg(begin, pose) > _LEFT_DEG
