"""Lens and scale of the outside camera from pictures of a printed ChArUco board.

OpenCV finds corners and fits pinhole and distortion. This module rejects image sets whose results
only look good: it checks how much of the image the corners cover, how well the focal length is
determined, and how many coefficients the images support.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]

LEAST_CORNERS = 12
LEAST_VIEWS = 4
_CELLS = (4, 3)
LEAST_COVER = 0.75
"""Share of the picture's 4 x 3 cells that must have seen corners."""
LEAST_LEAN_DEG = 20.0
"""Between some two of the boards; the focal length is not observable from parallel boards."""
MOST_FOCAL_DOUBT = 0.01
"""Largest standard deviation of the focal length, as a share of it."""
_MODELS = {
    "k1": cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1 k2": cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
    "k1 k2 p1 p2": cv2.CALIB_FIX_K3,
}


class BoardError(ValueError):
    """Images from which the lens cannot be estimated; the message says what to do."""


@dataclass(frozen=True)
class Board:
    """A board of `columns` x `rows` squares with markers of OpenCV's DICT_5X5_100."""

    columns: int = 11
    rows: int = 7
    square_mm: float = 6.0
    marker_mm: float = 4.5

    def __post_init__(self) -> None:
        """Raises BoardError: sizes that make no board, or more markers than there are."""
        if not (3 <= self.columns <= 40 and 3 <= self.rows <= 40):
            raise BoardError("a board has 3 to 40 columns and rows")
        if self.columns * self.rows // 2 > 100:
            raise BoardError(f"{self.columns} x {self.rows} squares need more than 100 markers")
        if not 0.3 * self.square_mm <= self.marker_mm <= 0.9 * self.square_mm:
            raise BoardError("a marker is 0.3 to 0.9 of its square")

    @property
    def size_mm(self) -> tuple[float, float]:
        """Width and height of the squares together."""
        return self.columns * self.square_mm, self.rows * self.square_mm

    def opencv(self) -> Any:
        """OpenCV's own board, lengths in mm."""
        dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        size = (self.columns, self.rows)
        return cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, dictionary)


@dataclass(frozen=True)
class Corners:
    """Inner corners found in one picture: their numbers (k,), and column and row (k, 2)."""

    ids: NDArray[np.int64]
    px: Floats

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True)
class LensFit:
    """Result of the calibration pictures.

    Attributes:
        matrix: pinhole, (3, 3), px.
        distortion: k1, k2, p1, p2, k3, (5,).
        model: which of them were fitted; the others are 0.
        scale_px_per_mm: on the plane of the first picture's board, at the picture's centre.
        tilt_deg: between that plane and the picture.
        residual_px: root mean square distance of corners from where the model puts them.
        residuals_px: the same of each picture used, (n,).
        cover: share of the picture's cells with corners.
        focal_doubt: standard deviation of the focal length, as a share of it.
        used: which of the pictures were used, (n,).
    """

    matrix: Floats
    distortion: Floats
    model: str
    scale_px_per_mm: float
    tilt_deg: float
    residual_px: float
    residuals_px: Floats
    cover: float
    focal_doubt: float
    used: NDArray[np.int64]


def find_corners(picture: Picture, board: Board) -> Corners:
    """The board's corners in a picture, none where it is not seen.

    Raises:
        BoardError: the board is seen mirrored, so from behind.
    """
    found = _detect(picture, board)
    if not len(found) and len(_detect(np.ascontiguousarray(picture[:, ::-1]), board)):
        raise BoardError("the board is seen mirrored: its printed side has to face the camera")
    return found


def _detect(picture: Picture, board: Board) -> Corners:
    detector = cv2.aruco.CharucoDetector(board.opencv())
    px, ids, _, _ = detector.detectBoard(picture)
    if ids is None or px is None:
        return Corners(np.empty(0, np.int64), np.empty((0, 2)))
    return Corners(np.asarray(ids, np.int64).reshape(-1), np.asarray(px, np.float64).reshape(-1, 2))


def fit_lens(views: Sequence[Corners], board: Board, size_px: tuple[int, int]) -> LensFit:
    """Lens, and scale on the plane of the first view.

    Args:
        views: the first with the board flat on the plate, the others leaning, all over the
            picture. Views with fewer than 12 corners are left out, but not the first.
        size_px: width and height of the pictures.

    Raises:
        BoardError: too few views or corners, corners in one part of the picture only, or boards
            that lean too little to determine the focal length.
    """
    if not views or len(views[0]) < LEAST_CORNERS:
        seen = len(views[0]) if views else 0
        raise BoardError(
            f"the board flat on the plate shows {seen} corners, at least {LEAST_CORNERS} are "
            "needed: is it hidden, out of focus, or another board?"
        )
    used = [i for i, view in enumerate(views) if len(view) >= LEAST_CORNERS]
    if len(used) < LEAST_VIEWS:
        raise BoardError(
            f"{len(used)} of {len(views)} pictures show at least {LEAST_CORNERS} corners, "
            f"{LEAST_VIEWS} are needed"
        )
    retained = [views[i] for i in used]
    cover = _cover(retained, size_px)
    if cover < LEAST_COVER:
        raise BoardError(
            f"corners were seen in {100 * cover:.0f} % of the picture, at least "
            f"{100 * LEAST_COVER:.0f} % is needed: hold the board into every corner of it"
        )
    places = np.asarray(board.opencv().getChessboardCorners(), np.float64)
    objects = [places[view.ids].astype(np.float32) for view in retained]
    pixels = [view.px.astype(np.float32) for view in retained]
    fits = {name: _fit(objects, pixels, size_px, flags) for name, flags in _MODELS.items()}
    model = _fewest(fits, sum(len(view) for view in retained))
    matrix, distortion, turns, shifts, doubts, residuals = fits[model]
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    lean = float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))).max())
    if lean < LEAST_LEAN_DEG:
        raise BoardError(
            f"the boards lean by {lean:.0f} degrees to each other at most, {LEAST_LEAN_DEG:.0f} "
            "are needed to tell the focal length: tilt the board by 20 to 40 degrees"
        )
    doubt = float(max(doubts[0] / matrix[0, 0], doubts[1] / matrix[1, 1]))
    if not doubt <= MOST_FOCAL_DOUBT:
        raise BoardError(
            f"the focal length is uncertain by {100 * doubt:.1f} %, at most "
            f"{100 * MOST_FOCAL_DOUBT:.0f} % is allowed: tilt the board more, 20 to 40 degrees "
            "about both axes"
        )
    scale, tilt = _on_plane(matrix, distortion, turns[0], shifts[0], size_px)
    weights = np.array([len(view) for view in retained], np.float64)
    total = float(np.sqrt((weights * residuals**2).sum() / weights.sum()))
    return LensFit(
        matrix, distortion, model, scale, tilt, total, residuals, cover, doubt, np.array(used)
    )


_Fit = tuple[Floats, Floats, list[Floats], list[Floats], Floats, Floats]


def _fit(objects: list[Any], pixels: list[Any], size_px: tuple[int, int], flags: int) -> _Fit:
    """Matrix, distortion, turns, shifts, standard deviations of intrinsics, residuals by view."""
    limit = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 200, 1e-12)
    try:
        found = cv2.calibrateCameraExtended(
            objects, pixels, size_px, None, None, flags=flags, criteria=limit
        )
    except cv2.error as error:
        raise BoardError(f"OpenCV could not fit a lens to the pictures: {error.err}") from None
    _, matrix, distortion, turns, shifts, doubts, _, residuals = found
    if not np.isfinite(matrix).all():
        raise BoardError("no lens fits the pictures: are they of one board and one camera?")
    return (
        np.asarray(matrix, np.float64),
        np.asarray(distortion, np.float64).reshape(-1)[:5],
        [np.asarray(v, np.float64).reshape(3) for v in turns],
        [np.asarray(v, np.float64).reshape(3) for v in shifts],
        np.asarray(doubts, np.float64).reshape(-1),
        np.asarray(residuals, np.float64).reshape(-1),
    )


def _fewest(fits: dict[str, _Fit], corners: int) -> str:
    """The model with the least Bayesian information criterion: coefficients have to earn it."""
    names = list(fits)
    best = names[0]
    for before, name in pairwise(names):
        more = len(name.split()) - len(before.split())
        squares = [float((fits[key][5] ** 2).mean()) for key in (best, name)]
        gain = 2 * corners * np.log(squares[0] / squares[1])
        if gain > 4 * more * np.log(2 * corners):  # four times: neighbouring corners err alike
            best = name
    return best


def _cover(views: Sequence[Corners], size_px: tuple[int, int]) -> float:
    cells = set()
    for view in views:
        column = np.clip(view.px[:, 0] * _CELLS[0] // size_px[0], 0, _CELLS[0] - 1)
        row = np.clip(view.px[:, 1] * _CELLS[1] // size_px[1], 0, _CELLS[1] - 1)
        cells |= set(zip(column.tolist(), row.tolist(), strict=True))
    return len(cells) / (_CELLS[0] * _CELLS[1])


def _on_plane(
    matrix: Floats, distortion: Floats, turn: Floats, shift: Floats, size_px: tuple[int, int]
) -> tuple[float, float]:
    """Scale (px/mm) where the picture's centre meets a board's plane, and its tilt (degrees)."""
    rotation = cv2.Rodrigues(turn)[0]
    centre = np.array([[[0.5 * (size_px[0] - 1), 0.5 * (size_px[1] - 1)]]])
    x, y = cv2.undistortPoints(centre, matrix, distortion).reshape(2)
    ray = np.array([x, y, 1.0])
    normal = rotation[:, 2]
    place = rotation.T @ (ray * (normal @ shift) / (normal @ ray) - shift)
    steps = place + 0.5 * np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    px = cv2.projectPoints(steps, turn, shift, matrix, distortion)[0].reshape(4, 2)
    growth = abs(float(np.linalg.det(np.array([px[0] - px[1], px[2] - px[3]]))))
    return growth**0.5, float(np.degrees(np.arccos(min(abs(normal[2]), 1.0))))
