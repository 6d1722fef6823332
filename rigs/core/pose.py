"""Conversion of poses to and from each controller's representation, all in this one place.

SlipLab uses mm and rotation vectors in degrees (`rigs.core.capabilities.Pose`). Universal Robots
controllers use metres and rotation vectors in radians (`p[x, y, z, rx, ry, rz]` of the URScript
manual). ABB controllers use mm and unit quaternions w x y z (RAPID `pose`). A rotation has several
rotation vectors and two quaternions; these functions return the canonical one: an angle of at most
180 degrees, and w >= 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sliplab.rigs.core.capabilities import Pose, Segment

MM_PER_M = 1000.0
TURN_PER_M = 4.0
"""Radians that a UR's `movel` turns a metre of its speed, where the tool turns on the spot.

Universal Robots does not document it; users measured it (forum, "MoveL: Tool Angular Speed"). The
driver holds the time that a turn took against it.
"""
F64 = npt.NDArray[np.float64]


def to_ur(pose: Pose) -> list[float]:
    """Convert `pose` to a UR controller's six values: x y z in m, rotation vector in rad."""
    return [*(value / MM_PER_M for value in pose.xyz_mm), *np.radians(pose.rotvec_deg).tolist()]


def from_ur(values: Sequence[float]) -> Pose:
    """Convert six values of a UR controller (m, rad) to a pose."""
    x, y, z = (value * MM_PER_M for value in values[:3])
    a, b, c = short_rotvec_deg(np.degrees(np.asarray(values[3:6], np.float64))[None])[0].tolist()
    return Pose((x, y, z), (a, b, c))


def quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """Return the tool's rotation as a unit quaternion w x y z with w >= 0."""
    return _quaternion(pose.rotvec_deg)


def from_quaternion(xyz_mm: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """Convert a position in mm and a quaternion w x y z of any non-zero norm to a pose."""
    w, a, b, c = (float(value) for value in wxyz)
    x, y, z = (float(value) for value in xyz_mm)
    return Pose((x, y, z), _rotvec_deg(w, a, b, c))


def short_rotvec_deg(rotvec_deg: F64) -> F64:
    """Return the same rotations with angles of at most 180 degrees, shape (n, 3).

    A controller may report a rotation as a vector longer than 180 degrees, and jump between two
    vectors for one rotation from one sample to the next.
    """
    if len(rotvec_deg) == 0:
        return rotvec_deg
    return np.degrees(Rotation.from_rotvec(np.radians(rotvec_deg)).as_rotvec())


def compose(one: Pose, other: Pose) -> Pose:
    """Compose two poses: `other`, given in the frame of `one`, in the frame of `one`'s parent."""
    rotation = _rotation(one)
    x, y, z = (np.asarray(one.xyz_mm) + rotation.apply(other.xyz_mm)).tolist()
    a, b, c = np.degrees((rotation * _rotation(other)).as_rotvec()).tolist()
    return Pose((x, y, z), (a, b, c))


def inverse(pose: Pose) -> Pose:
    """Return the inverse of `pose`: composed with it on either side, it gives the identity."""
    back = _rotation(pose).inv()
    x, y, z = (-back.apply(pose.xyz_mm)).tolist()
    a, b, c = np.degrees(back.as_rotvec()).tolist()
    return Pose((x, y, z), (a, b, c))


def angle_deg(one: Pose, other: Pose) -> float:
    """Angle of the smallest rotation from one pose's orientation to the other's, degrees."""
    if one.rotvec_deg == other.rotvec_deg:
        return 0.0
    return math.degrees((_rotation(one).inv() * _rotation(other)).magnitude())


def distance_mm(one: Pose, other: Pose) -> float:
    """Distance between two tool centre points, mm."""
    return math.dist(one.xyz_mm, other.xyz_mm)


def segment_seconds(begin: Pose, segment: Segment) -> float:
    """Duration of a segment from `begin` at its speed, without ramps, s."""
    if segment.turn_deg_s is not None:
        return angle_deg(begin, segment.to) / segment.turn_deg_s
    return distance_mm(begin, segment.to) / segment.speed_mm_s


def between(one: Pose, other: Pose, share: float) -> Pose:
    """Interpolate between two poses at `share` (0 to 1): linear, with the shortest rotation."""
    return straight_path(one, other)(share)


def straight_path(one: Pose, other: Pose) -> Callable[[float], Pose]:
    """Return the straight path with the shortest rotation, as a function of the share (0 to 1)."""
    (x, y, z), (u, v, w) = one.xyz_mm, other.xyz_mm

    def place(share: float) -> tuple[float, float, float]:
        return x + share * (u - x), y + share * (v - y), z + share * (w - z)

    if one.rotvec_deg == other.rotvec_deg:
        return lambda share: Pose(place(share), one.rotvec_deg)
    begin = _rotation(one)
    turn = (begin.inv() * _rotation(other)).as_rotvec()

    def pose(share: float) -> Pose:
        rotation = begin * Rotation.from_rotvec(turn * share)
        a, b, c = np.degrees(rotation.as_rotvec()).tolist()
        return Pose(place(share), (a, b, c))

    return pose


def _rotation(pose: Pose) -> Rotation:
    return Rotation.from_rotvec(np.radians(pose.rotvec_deg))


# A controller reports the same orientation hundreds of times a second: each is converted once.


@lru_cache(64)
def _quaternion(rotvec_deg: tuple[float, float, float]) -> tuple[float, float, float, float]:
    rotation = Rotation.from_rotvec(np.radians(rotvec_deg))
    w, x, y, z = rotation.as_quat(canonical=True, scalar_first=True).tolist()
    return w, x, y, z


@lru_cache(64)
def _rotvec_deg(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    rotation = Rotation.from_quat(np.array([w, x, y, z]), scalar_first=True)
    a, b, c = np.degrees(rotation.as_rotvec()).tolist()
    return a, b, c
