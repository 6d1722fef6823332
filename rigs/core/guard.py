"""Check of a move against the rig's limits before it is sent to an arm.

The controller has its own limits; these are the rig's, and protect the sensor and the plate. A
straight move stays inside a box if both its ends do, so only the ends are checked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sliplab.rigs.core.arm_settings import Limits
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.plate_frame import PlateFrame
from sliplab.rigs.core.pose import angle_deg

_EPS = 1e-6


class GuardError(RigError):
    """A move that the rig's limits forbid; nothing was sent to the arm.

    Attributes:
        what: name of the limited quantity.
        value: requested value, in `unit`.
        limit: allowed value, in `unit`.
    """

    def __init__(self, what: str, value: float, limit: float, unit: str, where: str) -> None:
        super().__init__(
            "arm", f"{where}: {what} {value:.4g} {unit} is beyond its limit {limit:.4g} {unit}"
        )
        self.what, self.value, self.limit = what, value, limit


class WorkspaceError(GuardError):
    """A tool centre point outside the workspace box."""


class SpeedError(GuardError):
    """A segment that is too fast, or whose speed is not positive."""


class DepthError(GuardError):
    """A tool centre point too far beyond the plate's plane."""


class TiltError(GuardError):
    """A segment that rotates the tool too far."""


class SingularityError(GuardError):
    """Joints too close to the wrist singularity, where two wrist axes align."""


class Guard:
    """Checks paths against one rig's limits.

    Raises:
        ValueError: limits in the plate's frame without a plate.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        plate = limits.plate
        if plate is None and (limits.frame == "plate" or limits.depth_mm is not None):
            raise ValueError("limits in the plate's frame need the taught plate (limits.plate)")
        self._frame = (
            PlateFrame.taught((plate.centre_mm, plate.right_mm, plate.above_mm))
            if plate is not None
            else None
        )

    def check(self, begin: Pose, path: Sequence[Segment]) -> None:
        """Check a path that starts at `begin` against the limits.

        `begin` itself may be outside: an arm that was jogged there must be able to return.

        Raises:
            GuardError: the first violation, with its value and its limit.
            RigError: a number that is not finite.
        """
        at = begin
        for index, segment in enumerate(path):
            where = f"segment {index + 1} of {len(path)}"
            numbers = (*segment.to.xyz_mm, *segment.to.rotvec_deg, segment.speed_mm_s)
            if not all(map(math.isfinite, numbers)):
                raise RigError("arm", f"{where} contains a number that is not finite")
            self._speed(segment.speed_mm_s, where)
            if segment.turn_deg_s is not None and not 0 < segment.turn_deg_s < math.inf:
                raise RigError("arm", f"{where} turns at {segment.turn_deg_s} deg/s")
            self._box(segment.to, where)
            self._depth(segment.to, where)
            turn = angle_deg(at, segment.to)
            if turn > self._limits.tilt_deg + _EPS:
                raise TiltError("turn of the tool", turn, self._limits.tilt_deg, "deg", where)
            at = segment.to

    def check_joints(self, joints_deg: Sequence[float]) -> None:
        """Check six joint angles (degrees) against the wrist singularity.

        Raises:
            SingularityError: joint 5 is within `singular_deg` of 0 or 180 degrees.
        """
        off = abs(math.remainder(joints_deg[4], 180.0))
        limit = self._limits.singular_deg
        if off < limit - _EPS:
            raise SingularityError(
                "joint 5, off its singular position by", off, limit, "deg", "joints now"
            )

    def _speed(self, speed_mm_s: float, where: str) -> None:
        limit = self._limits.speed_mm_s
        if speed_mm_s <= 0 or speed_mm_s > limit + _EPS:
            raise SpeedError("speed", speed_mm_s, limit, "mm/s", where)

    def _box(self, pose: Pose, where: str) -> None:
        limits = self._limits
        place: tuple[float, ...] = pose.xyz_mm
        if limits.frame == "plate" and self._frame is not None:
            seen = self._frame.position(pose.xyz_mm)
            place = (seen.x_mm, seen.y_mm, seen.depth_mm)
        for axis, value, low, high in zip("xyz", place, limits.low_mm, limits.high_mm, strict=True):
            if not low - _EPS <= value <= high + _EPS:
                limit = low if value < low else high
                name = f"{axis} in the {limits.frame} frame"
                raise WorkspaceError(name, value, limit, "mm", where)

    def _depth(self, pose: Pose, where: str) -> None:
        limit = self._limits.depth_mm
        if limit is None or self._frame is None:
            return
        depth = self._frame.position(pose.xyz_mm).depth_mm
        if depth > limit + _EPS:
            raise DepthError("depth", depth, limit, "mm", where)
