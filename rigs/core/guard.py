"""Checks of motion against limits: of a path before it is sent, and of poses while it runs.

The controller has its own limits; these are the rig's, and protect the sensor and the plate. A
straight move stays inside a box if both its ends do, so only the ends of a path are checked. The
rig checks every segment before any driver receives it; drivers check their own limits once more.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sliplab.rigs.core.arm_settings import ArmLimits
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg, distance_mm

_EPS = 1e-6
MEASURED_MM = 0.2
"""Largest distance of a measured pose beyond a limit: repeatability and noise of arms."""
LOOK_MM = 0.05
"""Largest difference of two looks at the pose of an arm at rest."""
MEASURED_DEG = 1.0
"""Largest measured turn of the tool beyond its limit."""


class GuardError(RigError):
    """A motion that the rig's limits forbid: refused before it was sent, or stopped on its way.

    Attributes:
        what: name of the limited quantity.
        value: requested or measured value, in `unit`.
        limit: allowed value, in `unit`.
    """

    def __init__(self, what: str, value: float, limit: float, unit: str, where: str) -> None:
        super().__init__(
            "arm", f"{where}: {what} {value:.4g} {unit} is beyond its limit {limit:.4g} {unit}"
        )
        self.what, self.value, self.limit = what, value, limit


class WorkspaceError(GuardError):
    """A tool centre point outside the workspace."""


class SpeedError(GuardError):
    """A segment that is too fast, or whose speed is not positive."""


class DepthError(GuardError):
    """A tool centre point too far beyond the plate's plane."""


class TiltError(GuardError):
    """A segment that rotates the tool too far."""


class SingularityError(GuardError):
    """Joints too close to the wrist singularity, where two wrist axes align."""


@dataclass(frozen=True)
class PlateLimits:
    """Limits in the frame of the plate that the rig uses, with the depth zero that was touched.

    Attributes:
        depth_mm: largest depth in contact: the arm's, and what a gripper's fingers add.
        reach_mm: largest distance of the sensor's centre from the plate's.
        speed_mm_s: of the sensor's centre, and of its rim in a turn on the spot.
        rim_mm: distance of the rim from the centre.
    """

    depth_mm: float
    reach_mm: float
    speed_mm_s: float
    rim_mm: float = 0.0


@dataclass(frozen=True)
class _Coordinate:
    """A limited coordinate of a pose, mm.

    Attributes:
        place: in its direction: of a distance from a centre, where that is measured.
    """

    error: type[GuardError]
    what: str
    value: float
    low: float
    high: float
    place: tuple[float, float] | None = None

    @property
    def excess(self) -> float:
        """Distance beyond the limits, mm; negative inside, NaN for an invalid value."""
        return max(self.low - self.value, self.value - self.high)

    def allowed(self, before: _Coordinate) -> float:
        """Return the largest excess on a way that began at `before`, mm: no more than there.

        None beyond the opposite limit: the way there leads through all that the limits protect.
        """
        if self.place is not None and before.place is not None:
            same = self.place[0] * before.place[0] + self.place[1] * before.place[1] > 0.0
        else:
            same = (self.value < self.low) == (before.value < before.low)
        return max(before.excess, 0.0) if same else 0.0

    def fault(self, where: str) -> GuardError:
        limit = self.low if self.value < self.low else self.high
        return self.error(self.what, self.value, limit, "mm", where)


class Guard:
    """Checks motion against one rig's limits.

    Args:
        limits: of the arm; None for none.
        plate_limits: of the rig file; None for none. Their frame is given with every check.

    Raises:
        ValueError: limits in the plate's frame without a plate.
    """

    def __init__(self, limits: ArmLimits | None, plate_limits: PlateLimits | None = None) -> None:
        self._limits, self._plate_limits = limits, plate_limits
        self._frame: PlateFrame | None = None
        if limits is None:
            return
        plate = limits.plate
        if plate is None and (limits.frame == "plate" or limits.depth_mm is not None):
            raise ValueError("limits in the plate's frame need the taught plate (limits.plate)")
        if plate is not None:
            self._frame = PlateFrame.taught((plate.centre_mm, plate.right_mm, plate.above_mm))

    @property
    def speed_mm_s(self) -> float:
        """Largest speed of a move."""
        return min(
            (each.speed_mm_s for each in (self._limits, self._plate_limits) if each is not None),
            default=math.inf,
        )

    @property
    def turn_deg_s(self) -> float:
        """Largest speed of a turn, on the spot or in a move, by that of the sensor's rim."""
        own = self._plate_limits
        return math.degrees(own.speed_mm_s / own.rim_mm) if own and own.rim_mm else math.inf

    def check(self, begin: Pose, path: Sequence[Segment]) -> None:
        """Check a path that starts at `begin` against the arm's limits.

        `begin` itself may be outside: an arm that was jogged there must be able to return. Where
        the plate is only the rig knows, which checks the way; here it may lead no farther outside.

        Raises:
            GuardError: the first violation, with its value and its limit.
            RigError: a number that is not finite.
        """
        self._check(begin, path, None, 0.0)

    def check_segment(
        self, begin: Pose, segment: Segment, plate: PlateFrame, closed_mm: float = 0.0
    ) -> None:
        """Check a segment against all limits, in the frame that the rig uses.

        A segment from outside must end inside, or lead straight out of the plate.

        Args:
            closed_mm: what the fingers add to the depth.

        Raises:
            GuardError: the first violation, with its value and its limit.
            RigError: a number that is not finite.
        """
        self._check(begin, [segment], plate, closed_mm)

    def _check(
        self, begin: Pose, path: Sequence[Segment], plate: PlateFrame | None, closed_mm: float
    ) -> None:
        at = begin
        for index, segment in enumerate(path):
            where = f"segment {index + 1} of {len(path)}"
            numbers = (*segment.to.xyz_mm, *segment.to.rotvec_deg, segment.speed_mm_s)
            if not all(map(math.isfinite, numbers)):
                raise RigError("arm", f"{where} contains a number that is not finite")
            turn = angle_deg(at, segment.to)
            self._speed(at, segment, turn, where)
            straight = plate is None or _is_straight_out(begin, segment.to, plate)
            before = self._places(begin, plate, closed_mm)
            after = self._places(segment.to, plate, closed_mm)
            for began, place in zip(before, after, strict=True):
                allowed = place.allowed(began)
                if not straight:
                    allowed = min(allowed, MEASURED_MM)
                elif began.excess > -LOOK_MM:  # the end is where an earlier look saw the arm
                    allowed += LOOK_MM
                if not place.excess <= allowed + _EPS:
                    raise place.fault(where)
            most = math.inf if self._limits is None else self._limits.tilt_deg
            if not turn <= most + _EPS:
                raise TiltError("turn of the tool", turn, most, "deg", where)
            at = segment.to

    def check_measured(
        self,
        pose: Pose,
        begin: Pose,
        plate: PlateFrame,
        closed_mm: float = 0.0,
        when: str = "on its way",
    ) -> None:
        """Check a pose that was measured, within `MEASURED_MM` and `MEASURED_DEG`.

        Args:
            begin: pose at which the path began, which may be outside; the path may not go farther.
            when: what the arm is doing, for the error.

        Raises:
            GuardError: the pose is outside, or turned too far.
        """
        where = f"the arm was stopped {when}, where its pose shows"
        before: list[_Coordinate] | None = None
        for number, place in enumerate(self._places(pose, plate, closed_mm)):
            if place.excess <= MEASURED_MM:
                continue
            before = before or list(self._places(begin, plate, closed_mm))
            if not place.excess <= place.allowed(before[number]) + MEASURED_MM:
                raise place.fault(where)
        if self._limits is None or pose.rotvec_deg == begin.rotvec_deg:
            return
        turn, most = angle_deg(begin, pose), self._limits.tilt_deg
        if not turn <= most + MEASURED_DEG:
            raise TiltError("turn of the tool", turn, most, "deg", where)

    def check_depth(self, depth_mm: float, what: str) -> None:
        """Check a measured depth in contact, in the rig's frame, that fingers would lead to.

        Raises:
            DepthError: it is beyond the limit.
        """
        own = self._plate_limits
        if own is not None and not depth_mm <= own.depth_mm + MEASURED_MM:
            raise DepthError("depth in contact", depth_mm, own.depth_mm, "mm", what)

    def check_joints(self, joints_deg: Sequence[float]) -> None:
        """Check six joint angles (degrees) against the wrist singularity.

        Raises:
            SingularityError: joint 5 is within `singular_deg` of 0 or 180 degrees.
        """
        if self._limits is None:
            return
        off = abs(math.remainder(joints_deg[4], 180.0))
        limit = self._limits.singular_deg
        if not off >= limit - _EPS:
            raise SingularityError(
                "joint 5, off its singular position by", off, limit, "deg", "joints now"
            )

    def _speed(self, at: Pose, segment: Segment, angle: float, where: str) -> None:
        limit = self.speed_mm_s
        if not 0 < segment.speed_mm_s <= limit + _EPS:
            raise SpeedError("speed", segment.speed_mm_s, limit, "mm/s", where)
        turn = segment.turn_deg_s
        if turn is None:
            self._turn_in_move(distance_mm(at, segment.to), segment.speed_mm_s, angle, where)
            return
        if not 0 < turn < math.inf:
            raise RigError("arm", f"{where} turns at {turn} deg/s")
        if self._plate_limits is not None:
            rim = math.radians(turn) * self._plate_limits.rim_mm
            if not rim <= self._plate_limits.speed_mm_s + _EPS:
                name = f"speed of the sensor's rim at {turn:g} deg/s:"
                raise SpeedError(name, rim, self._plate_limits.speed_mm_s, "mm/s", where)

    def _turn_in_move(self, way_mm: float, speed_mm_s: float, angle: float, where: str) -> None:
        """Check how fast the tool turns in a move: a controller turns it while it moves, at once
        if the way is short. `MEASURED_DEG` may be the difference of two looks."""
        most, seconds = self.turn_deg_s, way_mm / speed_mm_s
        if angle <= MEASURED_DEG or most == math.inf or angle <= most * seconds + _EPS:
            return
        name = f"speed of the turn by {angle:.3g} deg in a move of {way_mm:.2g} mm:"
        raise SpeedError(name, angle / seconds if seconds else math.inf, most, "deg/s", where)

    def _places(
        self, pose: Pose, plate: PlateFrame | None, closed_mm: float
    ) -> Iterator[_Coordinate]:
        """Return the limited coordinates of a pose."""
        limits, own = self._limits, self._plate_limits
        if limits is not None:
            taught = None if self._frame is None else self._frame.position(pose.xyz_mm)
            xyz: tuple[float, ...] = pose.xyz_mm
            if limits.frame == "plate" and taught is not None:
                xyz = (taught.x_mm, taught.y_mm, taught.depth_mm)
            for axis, value, low, high in zip(
                "xyz", xyz, limits.low_mm, limits.high_mm, strict=True
            ):
                name = f"{axis} in the {limits.frame} frame"
                yield _Coordinate(WorkspaceError, name, value, low, high)
            if limits.depth_mm is not None and taught is not None:
                yield _Coordinate(DepthError, "depth", taught.depth_mm, -math.inf, limits.depth_mm)
        if own is not None and plate is not None:
            here = plate.position(pose.xyz_mm)
            depth = here.depth_mm + closed_mm
            yield _Coordinate(DepthError, "depth in contact", depth, -math.inf, own.depth_mm)
            reach = math.hypot(here.x_mm, here.y_mm)
            name = "distance from the plate's centre"
            place = here.x_mm, here.y_mm
            yield _Coordinate(WorkspaceError, name, reach, -math.inf, own.reach_mm, place)


def _is_straight_out(begin: Pose, end: Pose, plate: PlateFrame) -> bool:
    """Return whether a move leads away from the plate along its normal."""
    one, other = plate.position(begin.xyz_mm), plate.position(end.xyz_mm)
    sideways_mm = math.hypot(other.x_mm - one.x_mm, other.y_mm - one.y_mm)
    return other.depth_mm < one.depth_mm and sideways_mm <= LOOK_MM
