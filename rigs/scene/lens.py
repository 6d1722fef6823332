"""From places in the plate's plane to pixels: a pinhole that may stand askew, a lens that bends.

Straight on, this is one scale. A tilt makes it a homography and a radial term bends it; both are
kept exact, because labels are read to a tenth of a pixel.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]


class Lens:
    """A camera fixed in the world whose axis meets the plate's origin in the picture's centre.

    Args:
        px_per_mm: scale at the picture's centre.
        width, height: the picture, px.
        tilt_deg: the plate's plane turned about the picture's x, then about its y.
        k1: first radial coefficient of Brown's model, in OpenCV's normalised coordinates (tangent
            of the angle from the axis).
        distance_mm: from the lens to the plate's origin; only matters with a tilt or a k1.
    """

    def __init__(
        self,
        px_per_mm: float,
        width: int,
        height: int,
        *,
        tilt_deg: tuple[float, float] = (0.0, 0.0),
        k1: float = 0.0,
        distance_mm: float = 300.0,
    ) -> None:
        self.px_per_mm, self.k1 = px_per_mm, k1
        self.straight = tilt_deg == (0.0, 0.0) and k1 == 0.0
        """Whether the picture is the plane at one scale."""
        a, b = (math.radians(angle) for angle in tilt_deg)
        # rows: x, y and depth over the distance, of the plane point (X, Y, 1) after both turns
        self._turn = np.array([
            [math.cos(b), math.sin(a) * math.sin(b), 0.0],
            [0.0, math.cos(a), 0.0],
            [-math.sin(b) / distance_mm, math.sin(a) * math.cos(b) / distance_mm, 1.0],
        ])  # fmt: skip
        self._centre = np.array([0.5 * (width - 1), 0.5 * (height - 1)])
        self._per_mm = 1.0 / distance_mm

    @property
    def homography(self) -> F64:
        """(3, 3), from (x mm, y mm, 1) in the plate's plane to pixels, without the radial term."""
        scale, (u, v) = self.px_per_mm, self._centre
        camera = np.array([[scale, 0.0, u], [0.0, -scale, v], [0.0, 0.0, 1.0]])
        result: F64 = camera @ self._turn
        return result

    def project(self, place_mm: F64) -> F64:
        """Column and row of places in the plate's plane, (..., 2) from (..., 2)."""
        seen = place_mm if self.straight else self._bent(place_mm)[0]
        result = np.empty_like(place_mm)
        result[..., 0] = self._centre[0] + self.px_per_mm * seen[..., 0]
        result[..., 1] = self._centre[1] - self.px_per_mm * seen[..., 1]
        return result

    def scale(self, place_mm: F64) -> F64:
        """Local scale, px/mm, (...,) from (..., 2): the square root of the area's growth.

        Determinant of the Jacobian: det(H) / w^3 for a homography, (1 + k1 r^2)(1 + 3 k1 r^2)
        for the radial term.
        """
        if self.straight:
            return np.full(place_mm.shape[:-1], self.px_per_mm)
        _, depth, r2 = self._bent(place_mm)
        area = np.linalg.det(self._turn) / depth**3
        area *= (1.0 + self.k1 * r2) * (1.0 + 3.0 * self.k1 * r2)
        result: F64 = self.px_per_mm * np.sqrt(area)
        return result

    def _bent(self, place_mm: F64) -> tuple[F64, F64, F64]:
        """Places as they seem, mm at the centre's scale; relative depth; squared tangent."""
        turned = place_mm @ self._turn[:, :2].T + self._turn[:, 2]
        depth = turned[..., 2]
        seen = turned[..., :2] / depth[..., None]
        r2 = (seen**2).sum(axis=-1) * self._per_mm**2
        return seen * (1.0 + self.k1 * r2)[..., None], depth, r2
