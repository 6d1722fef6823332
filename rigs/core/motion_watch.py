"""Measured poses while the arm follows a segment: within the limits, and showing the motion."""

from __future__ import annotations

import math
from collections.abc import Callable

from sliplab.rigs.core.capabilities import (
    Arm,
    ArmFault,
    Clock,
    Pose,
    PoseFault,
    Segment,
    StaysInContact,
)
from sliplab.rigs.core.guard import Guard, GuardError, SpeedError
from sliplab.rigs.core.host_clock import STEP_S, StallTimer
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg, distance_mm

END_MM, END_DEG = 1.0, 1.0
"""Largest distance from its end at which a path may be reported as finished."""
STUCK_S, STUCK_MM = 3.0, 0.5
"""Time, and motion at the commanded speed, in which the pose must change. A driver that knows its
pose only between pieces of a move updates it every two seconds at worst."""
SPEED_S, SPEED_SHARE, SPEED_MM, SPEED_DEG = 0.2, 0.2, 1.0, 1.0
"""Shortest time over which a speed is measured, and by how much it may be above the limit: poses
are noisy, and may be some packets old."""
REST_S, REST_LOOKS, REST_LIMIT_S = 0.2, 3, 2.0
"""Time between two looks at an arm that was stopped, over how many looks it must not have moved,
and the longest time until it does not, s."""
REST_MM, REST_DEG, STILL_MM, STILL_DEG = 0.2, 0.5, 0.05, 0.1
"""Largest difference of the poses of an arm at rest over these looks: measured poses are noisy; and
that over one look, which tells sooner."""
POSE_AGE_S = 0.2
"""How old a pose may be, s."""

_NUMBERS = 6


class MeasuredSpeedError(SpeedError, StaysInContact):
    """Poses are further apart than the limit of speed allows: the arm or they cannot be trusted."""


def check_pose(pose: Pose) -> Pose:
    """Return the pose.

    Raises:
        ArmFault: it does not hold six finite numbers.
    """
    try:
        numbers = (*pose.xyz_mm, *pose.rotvec_deg)
        usable = len(numbers) == _NUMBERS and all(map(math.isfinite, numbers))
    except (AttributeError, TypeError):
        usable = False
    if not usable:
        raise ArmFault("arm", f"reports {pose!r}, which is no pose; check its controller's state")
    return pose


def is_near(pose: Pose, end: Pose) -> bool:
    """Return whether a pose is at the end of a path, within `END_MM` and `END_DEG`."""
    if not distance_mm(pose, end) <= END_MM:
        return False
    return pose.rotvec_deg == end.rotvec_deg or angle_deg(pose, end) <= END_DEG


class MotionWatch:
    """The motion along one segment, which was checked and sent.

    Args:
        begin: measured pose at which it begins.
        plate: the plate's frame as the rig uses it.
        closed_mm: what the fingers add to the depth.
        now_ns: the rig's clock.
        poll_s: period at which poses are read.
    """

    def __init__(
        self,
        guard: Guard,
        segment: Segment,
        begin: Pose,
        plate: PlateFrame,
        closed_mm: float,
        now_ns: Callable[[], int],
        poll_s: float,
    ) -> None:
        self._guard, self._segment, self._begin = guard, segment, begin
        self._plate, self._closed_mm, self._now_ns = plate, closed_mm, now_ns
        self._stall = StallTimer(now_ns, max(STEP_S, 2 * poll_s))
        self._stall.waited_s(begin)
        self._stuck_s = STUCK_S + STUCK_MM / (segment.turn_deg_s or segment.speed_mm_s)
        self._past = now_ns(), begin

    def look(self, pose: Pose, asked_ns: int) -> None:
        """Hold a measured pose against the limits and the motion.

        Args:
            asked_ns: the rig's clock before the pose was read.

        Raises:
            GuardError: the pose is beyond a limit.
            MeasuredSpeedError: the speed is.
            PoseFault: the pose does not change although the arm should move.
        """
        try:
            self._guard.check_measured(pose, self._begin, self._plate, self._closed_mm)
        except GuardError:
            self._check_speed(pose)  # a place to which it cannot have come is not where it is
            raise
        still_s = self._stall.waited_s(pose)
        if still_s > self._stuck_s and not is_near(pose, self._segment.to):
            raise PoseFault(
                "arm",
                f"has reported the same pose for {still_s:.1f} s while it should move; it was "
                "stopped, and stays where it is: check its connection, and whether it moves",
            )
        past_ns, past = self._past
        # the time at which a pose was first seen counts
        if pose != past and (self._now_ns() - past_ns) * 1e-9 >= SPEED_S:
            self._check_speed(pose)
            self._past = asked_ns, pose

    def _check_speed(self, pose: Pose) -> None:
        """Hold the mean speeds since an earlier pose, of the way and of the turn, to the limits."""
        limit, (past_ns, past) = self._guard.speed_mm_s, self._past
        seconds = max(self._now_ns() - past_ns, 1) * 1e-9
        gone_mm = distance_mm(past, pose)
        where = "the arm was stopped on its way, and stays where it is"
        if not gone_mm <= (1.0 + SPEED_SHARE) * limit * seconds + SPEED_MM:
            raise MeasuredSpeedError("speed", gone_mm / seconds, limit, "mm/s", where)
        turn_deg, most = angle_deg(past, pose), self._guard.turn_deg_s
        if not turn_deg <= (1.0 + SPEED_SHARE) * most * seconds + SPEED_DEG:
            raise MeasuredSpeedError("turn", turn_deg / seconds, most, "deg/s", where)


class RestWatch:
    """The arm at rest after a motion: leaving its place before the next one is a fault.

    Args:
        place: where it ended, or was when it was stopped.
        now_ns: the rig's clock.
        coasts_mm: how far it may still go in `REST_LIMIT_S`, as it brakes and poses are old.
    """

    def __init__(self, place: Pose, now_ns: Callable[[], int], coasts_mm: float = 0.0) -> None:
        self._place, self._now_ns, self._coasts_mm = place, now_ns, coasts_mm
        self._settled_ns = now_ns() + round(REST_LIMIT_S * 1e9)

    def look(self, pose: Pose) -> None:
        """Hold a measured pose against the place. Raises PoseFault."""
        moved_mm, turned_deg = distance_mm(pose, self._place), angle_deg(pose, self._place)
        if not (moved_mm <= END_MM + self._coasts_mm and turned_deg <= END_DEG):
            raise PoseFault(
                "arm",
                f"moved {moved_mm:.1f} mm and {turned_deg:.1f} deg while it should rest, and was "
                "stopped where it is: look what moves it",
            )
        if self._coasts_mm and self._now_ns() >= self._settled_ns:
            self._place, self._coasts_mm = pose, 0.0


def seen_at_rest(arm: Arm, clock: Clock) -> bool:
    """Return whether the arm's path has ended and its poses stay.

    Raises:
        ArmFault: a pose cannot be used.
    """
    deadline = clock.now_ns() + round(REST_LIMIT_S * 1e9)
    poses = [check_pose(arm.pose())]
    while clock.now_ns() < deadline:
        clock.wait(REST_S)
        poses.append(check_pose(arm.pose()))
        still = _alike(poses[-2], poses[-1], STILL_MM, STILL_DEG)
        slow = len(poses) > REST_LOOKS and _alike(poses[-1 - REST_LOOKS], poses[-1])
        if (still or slow) and _path_over(arm):
            return True
    return False


def _alike(one: Pose, other: Pose, mm: float = REST_MM, deg: float = REST_DEG) -> bool:
    return distance_mm(one, other) <= mm and angle_deg(one, other) <= deg


def _path_over(arm: Arm) -> bool:
    try:
        progress = arm.progress()
    except Exception:  # a driver's fault, which is reported elsewhere; its poses tell enough
        return True
    return progress.done or not progress.state.healthy
