"""A board drawn before the simulated camera is where the camera's own lens would see it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sliplab.rigs.scene.board import VIEWS, BoardCamera, BoardPlace, BoardPrint, charuco, draw_board
from sliplab.rigs.scene.lens import Lens


@pytest.mark.parametrize(
    ("tilt", "k1"), [((0.0, 0.0), 0.0), ((3.0, -4.0), 0.0), ((-20.0, 12.0), -0.3)]
)
def test_the_camera_is_the_lens_of_the_plates_pictures(
    tilt: tuple[float, float], k1: float
) -> None:
    camera = BoardCamera(20.0, 1920, 1200, tilt, (k1,), 300.0)
    lens = Lens(20.0, 1920, 1200, tilt_deg=tilt, k1=k1, distance_mm=300.0)
    places = np.array([[10.0, 5.0], [-20.0, -9.0], [0.0, 0.0], [40.0, 25.0]])
    rotation, shift = camera.see(BoardPlace())
    on_board = np.column_stack([places[:, 0], -places[:, 1], 0 * places[:, 0]])
    px = cv2.projectPoints(
        on_board, cv2.Rodrigues(rotation)[0], shift, camera.matrix, camera.coefficients
    )[0].reshape(-1, 2)
    assert np.allclose(px, lens.project(places), atol=1e-6)


@pytest.mark.parametrize("number", [0, 2, 5])
def test_corners_are_drawn_where_they_are(number: int) -> None:
    board = BoardPrint()
    camera = BoardCamera(10.0, 960, 600, (2.0, 1.0), (-0.2, 0.1, 0.001, -0.001, 0.0))
    picture = draw_board(camera, VIEWS[number], board)
    px, ids, _, _ = cv2.aruco.CharucoDetector(charuco(board)).detectBoard(picture)
    assert len(ids) > 40
    rotation, shift = camera.see(VIEWS[number])
    middle = 0.5 * np.array([*board.size_mm, 0.0])
    places = charuco(board).getChessboardCorners()[ids.reshape(-1)] - middle
    true = cv2.projectPoints(
        places, cv2.Rodrigues(rotation)[0], shift, camera.matrix, camera.coefficients
    )[0].reshape(-1, 2)
    off = px.reshape(-1, 2) - true
    assert np.abs(off.mean(axis=0)).max() < 0.05
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.2


def test_a_board_beside_the_picture_is_not_in_it() -> None:
    camera = BoardCamera(10.0, 320, 200)
    picture = draw_board(camera, BoardPlace((500.0, 0.0, 0.0)), BoardPrint())
    assert np.all(picture == 25)
