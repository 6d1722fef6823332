"""Poses in and out of each arm's own language, converted in this one place.

SlipLab speaks mm and rotation vectors in degrees (`rigs.core.capabilities.Pose`). Universal Robots
controllers speak metres and rotation vectors in radians (`p[x, y, z, rx, ry, rz]` of the URScript
manual). ABB controllers speak mm and unit quaternions w x y z (RAPID `pose`). A rotation has
several rotation vectors and two quaternions; what comes out here is always the short one: an angle
of at most 180 degrees, and w >= 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sliplab.rigs.core.capabilities import Pose

MM_PER_M = 1000.0
F64 = npt.NDArray[np.float64]


def to_ur(pose: Pose) -> list[float]:
    """`pose` as a UR controller writes it: x y z in m, rotation vector in rad."""
    return [*(value / MM_PER_M for value in pose.xyz_mm), *np.radians(pose.rotvec_deg).tolist()]


def from_ur(values: Sequence[float]) -> Pose:
    """The pose of six values of a UR controller (m, rad)."""
    x, y, z = (value * MM_PER_M for value in values[:3])
    a, b, c = short_rotvec_deg(np.degrees(np.asarray(values[3:6], np.float64))[None])[0].tolist()
    return Pose((x, y, z), (a, b, c))


def quaternion(pose: Pose) -> tuple[float, float, float, float]:
    """Return the tool's rotation as a unit quaternion w x y z with w >= 0."""
    w, x, y, z = _rotation(pose).as_quat(canonical=True, scalar_first=True).tolist()
    return w, x, y, z


def from_quaternion(xyz_mm: Sequence[float], wxyz: Sequence[float]) -> Pose:
    """The pose of a place in mm and a quaternion w x y z of any length but 0."""
    rotation = Rotation.from_quat(np.asarray(wxyz, np.float64), scalar_first=True)
    x, y, z = (float(value) for value in xyz_mm)
    a, b, c = np.degrees(rotation.as_rotvec()).tolist()
    return Pose((x, y, z), (a, b, c))


def short_rotvec_deg(rotvec_deg: F64) -> F64:
    """The same rotations with angles of at most 180 degrees, shape (n, 3).

    A controller may report one turn as a vector longer than 180 degrees, and jump between two
    vectors for one rotation from one sample to the next.
    """
    if len(rotvec_deg) == 0:
        return rotvec_deg
    return np.degrees(Rotation.from_rotvec(np.radians(rotvec_deg)).as_rotvec())


def compose(one: Pose, other: Pose) -> Pose:
    """`other`, given in the frame that `one` describes, in the frame that `one` is given in."""
    rotation = _rotation(one)
    x, y, z = (np.asarray(one.xyz_mm) + rotation.apply(other.xyz_mm)).tolist()
    a, b, c = np.degrees((rotation * _rotation(other)).as_rotvec()).tolist()
    return Pose((x, y, z), (a, b, c))


def inverse(pose: Pose) -> Pose:
    """The pose that undoes `pose`: composed with it, either way, it is the origin."""
    back = _rotation(pose).inv()
    x, y, z = (-back.apply(pose.xyz_mm)).tolist()
    a, b, c = np.degrees(back.as_rotvec()).tolist()
    return Pose((x, y, z), (a, b, c))


def angle_deg(one: Pose, other: Pose) -> float:
    """Angle of the smallest turn from one pose's rotation to the other's, degrees."""
    return math.degrees((_rotation(one).inv() * _rotation(other)).magnitude())


def distance_mm(one: Pose, other: Pose) -> float:
    """Distance between two tool centre points, mm."""
    return math.dist(one.xyz_mm, other.xyz_mm)


def between(one: Pose, other: Pose, share: float) -> Pose:
    """The pose at `share` (0 to 1) of the straight way with the shortest turn."""
    return way(one, other)(share)


def way(one: Pose, other: Pose) -> Callable[[float], Pose]:
    """The straight way with the shortest turn from one pose to the other, by its share."""
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
