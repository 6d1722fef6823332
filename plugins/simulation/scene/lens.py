"""Projection of the plate's plane to pixels: a pinhole that may be tilted, and lens distortion.

Straight on, this is one scale. A tilt makes it a homography and a radial term bends it; both are
modelled exactly, because labels are read to a tenth of a pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sliplab.protocols.later import Later
from sliplab.storage.kernels import njit
from sliplab.storage.streams import F32, F64, U8

if TYPE_CHECKING:
    import cv2
else:
    cv2 = Later("cv2")


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
        """True if the picture is the plane at one scale."""
        a, b = (math.radians(angle) for angle in tilt_deg)
        # rows: x, y and depth over the distance, of the plane point (X, Y, 1) after both turns
        self._turn = np.array(
            [
                [math.cos(b), math.sin(a) * math.sin(b), 0.0],
                [0.0, math.cos(a), 0.0],
                [-math.sin(b) / distance_mm, math.sin(a) * math.cos(b) / distance_mm, 1.0],
            ]
        )
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


_FINE = 2
"""Rays a pixel, along each axis."""
_PRINT_PX_PER_MM = 24
_TURNS = 8
"""Of the fixed point that takes the distortion off; each leaves a few percent of the error."""


@dataclass(frozen=True)
class BoardPrint:
    """A board of `columns` x `rows` squares; by default that of `sliplab calibrate board`."""

    columns: int = 11
    rows: int = 7
    square_mm: float = 6.0
    marker_mm: float = 4.5

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the squares together."""
        return self.columns * self.square_mm, self.rows * self.square_mm


@dataclass(frozen=True)
class BoardPlace:
    """Pose of a board: its centre in plate coordinates (z away from the camera), turns.

    The board faces the camera; turned by `spin_deg` in its plane, then by `lean_deg`
    about the plate's x and y.
    """

    centre_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    lean_deg: tuple[float, float] = (0.0, 0.0)
    spin_deg: float = 0.0
    mirrored: bool = False
    """Seen from behind, as on a transparent sheet."""

    @property
    def rotation(self) -> F64:
        """(3, 3), columns: board's right, board's down, away from the camera, in plate axes."""
        a, b, c = (math.radians(v) for v in (*self.lean_deg, self.spin_deg))
        about_x = np.array(
            [[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]]
        )
        about_y = np.array(
            [[math.cos(b), 0, math.sin(b)], [0, 1, 0], [-math.sin(b), 0, math.cos(b)]]
        )
        spin = np.array([[math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1]])
        face = np.diag([-1.0 if self.mirrored else 1.0, -1.0, 1.0])
        result: F64 = about_y @ about_x @ spin @ face
        return result


VIEWS = (
    BoardPlace(),
    BoardPlace((-12.0, 6.0, 6.0), (28.0, 0.0)),
    BoardPlace((12.0, -6.0, 6.0), (-28.0, 5.0), 180.0),
    BoardPlace((-10.0, -6.0, 4.0), (0.0, 30.0), 15.0),
    BoardPlace((10.0, 6.0, 4.0), (5.0, -30.0), -20.0),
    BoardPlace((0.0, 0.0, 20.0), (20.0, 22.0), 90.0),
    BoardPlace((-18.0, 10.0, 0.0), (-15.0, -18.0), 5.0),
    BoardPlace((18.0, -10.0, 0.0), (18.0, 16.0), -8.0),
)
"""Poses of a board in careful hands: flat on the plate first, then leaning, all over."""


@dataclass(frozen=True)
class BoardCamera:
    """The camera of `scene.lens`, for what is not in the plate's plane."""

    px_per_mm: float
    width: int
    height: int
    tilt_deg: tuple[float, float] = (0.0, 0.0)
    distortion: tuple[float, ...] = (0.0,)
    """k1, or k1, k2, p1, p2, k3."""
    distance_mm: float = 300.0

    @property
    def matrix(self) -> F64:
        """(3, 3), pinhole."""
        focal = self.px_per_mm * self.distance_mm
        centre = 0.5 * (self.width - 1), 0.5 * (self.height - 1)
        return np.array([[focal, 0.0, centre[0]], [0.0, focal, centre[1]], [0.0, 0.0, 1.0]])

    @property
    def coefficients(self) -> F64:
        """(5,), as OpenCV wants them."""
        return np.array((*self.distortion, *(0.0,) * (5 - len(self.distortion))))

    def see(self, place: BoardPlace) -> tuple[F64, F64]:
        """Rotation (3, 3) and translation (3,), mm, from the board to the camera (y down)."""
        a, b = (math.radians(angle) for angle in self.tilt_deg)
        turn = np.array(
            [
                [math.cos(b), math.sin(a) * math.sin(b), math.cos(a) * math.sin(b)],
                [0.0, math.cos(a), -math.sin(a)],
                [-math.sin(b), math.sin(a) * math.cos(b), math.cos(a) * math.cos(b)],
            ]
        )
        flip = np.diag([1.0, -1.0, 1.0])
        rotation: F64 = flip @ turn @ place.rotation
        shift: F64 = flip @ turn @ np.array(place.centre_mm) + np.array(
            [0.0, 0.0, self.distance_mm]
        )
        return rotation, shift


def charuco(board: BoardPrint) -> cv2.aruco.CharucoBoard:
    """OpenCV's board; its markers are of another dictionary than the plate's."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    size = (board.columns, board.rows)
    return cv2.aruco.CharucoBoard(size, board.square_mm, board.marker_mm, dictionary)


def draw_board(
    camera: BoardCamera, place: BoardPlace, board: BoardPrint, *, dark: int = 25, bright: int = 200
) -> U8:
    """The picture of a board, (height, width), on a dark ground, without noise."""
    scale = _PRINT_PX_PER_MM
    margin = round(board.square_mm * scale)
    width, height = (round(side * scale) for side in board.size_mm)
    print_ = charuco(board).generateImage((width, height), marginSize=0)
    print_ = cv2.copyMakeBorder(
        print_, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255
    )
    rotation, shift = camera.see(place)
    where = np.empty((2, camera.height * _FINE, camera.width * _FINE), np.float32)
    offset = np.array([0.5 * side * scale + margin - 0.5 for side in board.size_mm])
    _meet(camera.matrix, camera.coefficients, rotation, shift, offset, float(scale), where)
    level = (dark + print_ / 255.0 * (bright - dark)).astype(np.float32)
    fine = cv2.remap(
        level,
        where[0],
        where[1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=float(dark),
    )
    small = cv2.resize(fine, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    result: U8 = np.rint(small).astype(np.uint8)
    return result


@njit(cache=True, nogil=True, error_model="numpy")
def _meet(
    matrix: F64, coefficients: F64, rotation: F64, shift: F64, offset: F64, scale: float, where: F32
) -> None:
    """Find where in the print each ray meets the board, column and row, (2, rows, columns)."""
    k1, k2, p1, p2, k3 = coefficients
    # in the board's axes: the camera's place, and each ray's direction
    eye = -(rotation.T @ shift)
    turns = _TURNS if np.any(coefficients) else 0
    for i in range(where.shape[1]):
        y0 = ((i + 0.5) / _FINE - 0.5 - matrix[1, 2]) / matrix[1, 1]
        for j in range(where.shape[2]):
            x0 = ((j + 0.5) / _FINE - 0.5 - matrix[0, 2]) / matrix[0, 0]
            x, y = x0, y0
            for _ in range(turns):
                r2 = x * x + y * y
                radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
                dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
                dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
                x, y = (x0 - dx) / radial, (y0 - dy) / radial
            along = -eye[2] / (rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2])
            u = eye[0] + along * (rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0])
            v = eye[1] + along * (rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1])
            where[0, i, j], where[1, i, j] = u * scale + offset[0], v * scale + offset[1]
