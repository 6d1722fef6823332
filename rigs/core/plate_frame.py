"""Transformation between plate coordinates and the arm's base frame.

A protocol uses plate coordinates (right, up, depth); an arm uses its base frame. The contact plane,
taught by touching three points, relates the two: without it, a tilt of 0.4 degrees over a slide of
15 mm would be half a depth step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from sliplab.protocols.program import Position
from sliplab.rigs.core.capabilities import Mounting, Pose

Vector = npt.NDArray[np.float64]
Rows = tuple[tuple[float, float, float], ...]


@dataclass(frozen=True)
class PlateFrame:
    """A right-handed frame on the contact plane, in the arm's base frame.

    Attributes:
        origin: the plate's centre, mm, shape (3,).
        axes: rows are the unit vectors x (right, as the outside camera sees the plate), y (up) and
            z (into the plate), shape (3, 3). The tool's axes are parallel to them.
        zero_mm: depth at which the highest papilla touches, found by touching off.
    """

    origin: Vector
    axes: Vector
    zero_mm: float = 0.0

    @staticmethod
    def taught(points_mm: Sequence[Sequence[float]]) -> PlateFrame:
        """Build the frame from three touched points: centre, one to its right, one above it.

        Raises:
            ValueError: the points are on one line, or closer than 5 mm to each other.
        """
        centre, right, above = (np.asarray(point, dtype=np.float64) for point in points_mm)
        if min(np.linalg.norm(right - centre), np.linalg.norm(above - centre)) < 5.0:
            raise ValueError("the taught points must be at least 5 mm from the centre")
        x = (right - centre) / np.linalg.norm(right - centre)
        z = np.cross(x, above - centre)
        length = np.linalg.norm(z)
        if length < 0.2 * np.linalg.norm(above - centre):
            raise ValueError("the three taught points lie almost on one line")
        z /= length
        return PlateFrame(centre, np.array([x, np.cross(z, x), z]))

    def with_zero(self, zero_mm: float) -> PlateFrame:
        """Return the same frame with another depth zero."""
        return PlateFrame(self.origin, self.axes, zero_mm)

    def pose(self, position: Position) -> Pose:
        """Return the pose at a position in plate coordinates, the tool facing the plate."""
        x, y, z = self.axes
        depth = position.depth_mm + self.zero_mm
        xyz = self.origin + position.x_mm * x + position.y_mm * y + depth * z
        rotvec_deg = self._rotvec_deg
        if position.twist_deg:
            rotvec_deg = turned_about_z(rotvec_deg, position.twist_deg)
        return Pose((float(xyz[0]), float(xyz[1]), float(xyz[2])), rotvec_deg)

    @cached_property
    def _rotvec_deg(self) -> tuple[float, float, float]:
        """The tool's rotation vector, the same at every position."""
        rotation = Rotation.from_matrix(np.column_stack(tuple(self.axes)))
        a, b, c = np.degrees(rotation.as_rotvec()).tolist()
        return a, b, c

    def position(self, xyz_mm: Sequence[float]) -> Position:
        """Convert a tool centre point in the base frame to plate coordinates, not twisted."""
        x, y, z = self.axes @ (np.asarray(xyz_mm, dtype=np.float64) - self.origin)
        return Position(float(x), float(y), float(z) - self.zero_mm)

    def force_matrix(self, mounting: Mounting) -> Rows:
        """Return the rows of the matrix from a sensor's reading to the force on the plate.

        The product is in plate coordinates: x right, y up, z into the plate.
        """
        turn: Vector = Rotation.from_rotvec(np.radians(mounting.rotvec_deg)).as_matrix()
        if mounting.axes == "base":
            turn = self.axes @ turn
        signed = turn if mounting.feels == "plate" else -turn
        rows = (signed + 0.0).tolist()  # no negative zeros
        return tuple((float(a), float(b), float(c)) for a, b, c in rows)


def turned_about_z(
    rotvec_deg: tuple[float, float, float], angle_deg: float
) -> tuple[float, float, float]:
    """Return a rotation vector, degrees, after a rotation about the tool's own z axis."""
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(angle_deg)])
    rotation = Rotation.from_rotvec(np.radians(rotvec_deg)) * turn
    a, b, c = np.degrees(rotation.as_rotvec()).tolist()
    return a, b, c
