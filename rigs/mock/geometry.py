"""From arm poses to the sensor's place over the true plate, and rotation vectors on the way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.mock.settings import Contact

F64 = npt.NDArray[np.float64]


@lru_cache(maxsize=64)
def matrix(rotvec_deg: tuple[float, float, float]) -> F64:
    """Rotation matrix of a rotation vector in degrees (Rodrigues), shape (3, 3), not to be changed.

    Kept: a tool seldom turns.
    """
    vector = np.radians(np.asarray(rotvec_deg, np.float64))
    angle = float(np.sqrt(vector @ vector))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + math.sin(angle) * cross + (1.0 - math.cos(angle)) * (cross @ cross)


def rotvec_deg(rotation: F64) -> tuple[float, float, float]:
    """Rotation vector of a matrix, degrees; for angles below 180."""
    axis = np.array([
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    ])  # fmt: skip
    sine = 0.5 * float(np.sqrt(axis @ axis))
    angle = math.atan2(sine, 0.5 * (float(np.trace(rotation)) - 1.0))
    scale = 0.5 if sine < 1e-12 else 0.5 * angle / sine
    x, y, z = np.degrees(axis * scale).tolist()
    return x, y, z


class ContactPlane:
    """The true surface of the plate in the arm's base frame: x right, y up, z into the plate.

    Right, up and into make a right-handed frame as the outside camera sees it, from behind.
    """

    def __init__(self, origin_mm: F64, rotation: F64, tip_mm: F64 | None = None) -> None:
        """`tip_mm`: where the tip truly is from the reported tool centre point, in tool axes."""
        self.origin_mm = origin_mm
        self.rotation = rotation
        self.tip_mm = np.zeros(3) if tip_mm is None else tip_mm

    @classmethod
    def from_settings(cls, contact: Contact, tip_mm: Sequence[float] = (0, 0, 0)) -> ContactPlane:
        """The nominal plane, tilted about an axis in it and set back along its normal."""
        nominal = matrix(contact.nominal_rotvec_deg)
        azimuth = math.radians(contact.tilt_axis_deg)
        tilt = matrix((
            contact.tilt_deg * math.cos(azimuth), contact.tilt_deg * math.sin(azimuth), 0.0,
        ))  # fmt: skip
        rotation = nominal @ tilt
        origin = np.asarray(contact.nominal_origin_mm) + contact.offset_mm * rotation[:, 2]
        return cls(origin, rotation, np.asarray(tip_mm, np.float64))

    def pose(self, x_mm: float, y_mm: float, depth_mm: float) -> Pose:
        """The tool pose that puts the sensor squarely there."""
        place = np.array([x_mm, y_mm, depth_mm]) - self.tip_mm
        x, y, z = (self.origin_mm + self.rotation @ place).tolist()
        return Pose((x, y, z), rotvec_deg(self.rotation))

    def sensor(self, pose: Pose) -> F64:
        """x, y, depth (mm) of the highest tip, and depth's slopes over the layout, shape (5,).

        Turning about the plate's normal is left out: the skin looks much the same after it.
        """
        tool = self.rotation.T @ matrix(pose.rotvec_deg)
        place = self.rotation.T @ (np.asarray(pose.xyz_mm) - self.origin_mm) + tool @ self.tip_mm
        return np.array([*place, tool[2, 0], tool[2, 1]])

    def turned_deg(self, pose: Pose) -> float:
        """Angle between the tool's axes and the plate's."""
        trace = float(np.trace(self.rotation.T @ matrix(pose.rotvec_deg)))
        return math.degrees(math.acos(min(max(0.5 * (trace - 1.0), -1.0), 1.0)))
