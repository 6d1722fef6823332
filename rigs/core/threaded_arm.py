"""Common parts of the drivers of real arms: a thread follows a path and records its progress.

Each driver has its own connection, and its own means to send a path and to stop. How progress is
reported and how a failed path ends are the same for all drivers.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field

from sliplab.rigs.core.arm_settings import ArmLimits
from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Progress, RigError, Segment
from sliplab.rigs.core.guard import Guard
from sliplab.rigs.core.pose import angle_deg, distance_mm
from sliplab.rigs.core.pose_stream import PoseStream
from sliplab.storage.streams import PoseChunk, PulseChunk

LEFT_MM = 0.001
"""Distance from its rest position at which the tool centre point has begun a segment."""
NEAR_MM = 0.05
"""Largest distance from its target at which a segment may end."""
REST_SHARE = 0.02
"""Share of its speed below which a segment, near its target, has ended."""
_LEFT_DEG, _NEAR_DEG = 0.001, 0.1


@dataclass
class Run:
    """One run of a path; before the first, an empty run that is done."""

    path: Sequence[Segment]
    finished: list[tuple[int, int]] = field(default_factory=list)
    """Start and end of finished segments, controller clock in ns."""
    done: bool = False
    cancelled: bool = False
    """True once a stop was requested."""
    error: ArmFault | None = None
    """Reason why the path was aborted, where the arm's state does not show it."""
    thread: threading.Thread | None = None

    def progress(self, state: ArmState) -> Progress:
        """Return the progress of the path.

        Raises:
            ArmFault: the path was aborted for a reason that `state` does not show: the arm is
                healthy, or its program was ended for that reason.
        """
        if self.error is not None and (state.healthy or state is ArmState.NOT_RUNNING):
            raise self.error
        return Progress(state, tuple(self.finished), self.done)

    def join(self, within_s: float) -> None:
        """Wait for the path's thread to end; returns at once in that thread itself."""
        if self.thread is not None and self.thread is not threading.current_thread():
            self.thread.join(within_s)


class ThreadedArm(ABC):
    """A base for drivers of arms that follow a path in a separate thread.

    A subclass implements `state`, `_follow_path` and `_abort`.
    """

    def __init__(self, limits: ArmLimits) -> None:
        self._guard = Guard(limits)
        self._stream = PoseStream()
        self._lost: str | None = "not connected"
        """Reason why the arm cannot be reached; None while it can."""
        self._run = Run((), done=True)

    @abstractmethod
    def state(self) -> ArmState:
        """Return the arm's state without waiting."""

    def progress(self) -> Progress:
        """Return the progress of the path.

        Raises:
            ArmFault: the path was aborted for a reason that `state` does not show.
        """
        return self._run.progress(self.state())

    def read_poses(self) -> PoseChunk:
        """Return the measured poses since the last call."""
        return self._stream.read()

    def read_pulses(self) -> PulseChunk:
        """Return the rising edges of the sync input since the last call."""
        return self._stream.read_pulses()

    def _begin(self, run: Run) -> None:
        """Start the thread that follows a path."""
        run.thread = threading.Thread(target=self._follow, args=(run,), daemon=True)
        run.thread.start()

    def _follow(self, run: Run) -> None:
        """Run a path's thread; an exception in it must not look like a stop from outside."""
        try:
            self._follow_path(run)
        except Exception as error:
            aborted = ArmFault("arm", f"its path was aborted: {error!r}")
            run.error = error if isinstance(error, ArmFault) else aborted
            self._abort()
        finally:
            run.done = True
            self._on_path_end()

    @abstractmethod
    def _follow_path(self, run: Run) -> None:
        """Wait for each segment to end, and append it to `run.finished`. May raise anything."""

    @abstractmethod
    def _abort(self) -> None:
        """Stop the arm, whose path is no longer followed."""

    def _on_path_end(self) -> None:
        """Wake the threads that wait for poses: the path's thread is ending."""
        self._stream.wake()

    def _refuse(self, path: Sequence[Segment], moving: bool) -> None:
        """Raise RigError if the path is empty or the arm is still moving."""
        if not path:
            raise RigError("arm", "received an empty path")
        if moving:
            raise RigError("arm", "is still moving; wait for its path to end, or stop it")

    def _fault(self, state: ArmState, what: str) -> ArmFault:
        reason = f" ({self._lost})" if state is ArmState.DISCONNECTED and self._lost else ""
        return ArmFault("arm", f"{what}: {state.value}{reason}; {state.advice}")


class SegmentWatch:
    """Detects start and end of each segment of a path from the pose stream alone.

    For controllers that do not report them: commanded poses are exact, so departure from one
    position and rest at the next can be seen to a sample.

    Args:
        begin: pose of the arm at rest before the path.
        path: segments, each from rest to rest.
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

    def add(self, t_ns: int, pose: Pose) -> tuple[int, int] | None:
        """Add one sample; return start and end of the segment that ended with it, if any."""
        before, self._before = self._before, (t_ns, pose)
        if self.done or before is None or t_ns <= before[0]:
            return None
        if self._start_ns is None and not has_left(self._begin, pose):
            return None
        if self._start_ns is None:
            self._start_ns = before[0]
        segment = self._path[self._count]
        if segment.turn_deg_s is None:
            gone, full = distance_mm(before[1], pose), segment.speed_mm_s
        else:
            gone, full = angle_deg(before[1], pose), segment.turn_deg_s
        speed = gone / (t_ns - before[0]) * 1e9
        if not is_at(pose, segment.to) or speed > REST_SHARE * full:
            return None
        times = self._start_ns, t_ns
        self._begin, self._start_ns = pose, None
        self._count += 1
        return times


def is_at(pose: Pose, target: Pose) -> bool:
    """Return whether a pose is close enough to a target for a segment to have ended."""
    return distance_mm(pose, target) <= NEAR_MM and angle_deg(pose, target) <= _NEAR_DEG


def has_left(begin: Pose, pose: Pose) -> bool:
    """Return whether a pose differs from the pose at rest, `begin`."""
    return distance_mm(begin, pose) > LEFT_MM or angle_deg(begin, pose) > _LEFT_DEG
