"""A path that an arm follows: how far it has come, and when each segment began and ended."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass, field

from sliplab.rigs.core.capabilities import ArmFault, ArmState, Pose, Progress, Segment
from sliplab.rigs.core.pose import angle_deg, distance_mm


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
    """Why the path was given up, where the arm's state does not tell."""
    thread: threading.Thread | None = None

    def progress(self, state: ArmState) -> Progress:
        """How far it has come.

        Raises:
            ArmFault: it was given up for a reason that `state` does not say: the arm is healthy, or
                its program was ended because of that reason.
        """
        if self.error is not None and (state.healthy or state is ArmState.NOT_RUNNING):
            raise self.error
        return Progress(state, tuple(self.finished), self.done)


LEFT_MM = 0.001
"""A segment has begun once the tool centre point is this far from where it stood."""
NEAR_MM = 0.05
"""How close to its target a segment may end."""
REST_SHARE = 0.02
"""Below this share of its speed, near its target, a segment has ended."""
_LEFT_DEG, _NEAR_DEG = 0.001, 0.1


class SegmentWatch:
    """Follows one path sample by sample.

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
        """Whether every segment has ended."""
        return self._count == len(self._path)

    @property
    def begun(self) -> bool:
        """Whether the arm has left the place where the path begins."""
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
    """Whether a pose is as close to a target as a segment that has ended."""
    return distance_mm(pose, target) <= NEAR_MM and angle_deg(pose, target) <= _NEAR_DEG


def has_left(begin: Pose, pose: Pose) -> bool:
    """Whether a pose is another one than where the arm stood."""
    return distance_mm(begin, pose) > LEFT_MM or angle_deg(begin, pose) > _LEFT_DEG
