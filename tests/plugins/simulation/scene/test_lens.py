"""The lens against a pinhole written out in three dimensions, and its scale against differences."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sliplab.plugins.simulation.scene.lens import (
    VIEWS,
    BoardCamera,
    BoardPlace,
    BoardPrint,
    Lens,
    charuco,
    draw_board,
)

PLACES = np.random.default_rng(3).uniform(-20.8, 20.8, (50, 2))
TILT = st.floats(-20.0, 20.0)


def pinhole(place: np.ndarray, tilt: tuple[float, float], k1: float, away: float) -> np.ndarray:
    """One place after another: turn about x, then y; divide by depth; Brown's radial term."""
    turn = Rotation.from_euler("xy", tilt, degrees=True)
    result = []
    for x, y in place:
        px, py, pz = turn.apply([x, y, 0.0])
        u, v = px / (away + pz), py / (away + pz)
        bent = 1.0 + k1 * (u * u + v * v)
        result.append([415.5 + 20.0 * away * u * bent, 415.5 - 20.0 * away * v * bent])
    return np.array(result)


def seen(camera: BoardCamera, places: Any, rotation: Any, shift: Any) -> Any:
    """Where OpenCV's model of a camera sees places, px."""
    turned = cv2.Rodrigues(rotation)[0]
    px = cv2.projectPoints(places, turned, shift, camera.matrix, camera.coefficients)[0]
    return px.reshape(-1, 2)


@given(tilt=st.tuples(TILT, TILT), k1=st.floats(-0.5, 0.5), away=st.floats(100.0, 2000.0))
def test_it_is_a_pinhole(tilt: tuple[float, float], k1: float, away: float) -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=tilt, k1=k1, distance_mm=away)
    assert lens.project(PLACES) == pytest.approx(pinhole(PLACES, tilt, k1, away), abs=1e-8)


def test_without_a_radial_term_it_is_its_homography() -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=(5.0, -4.0))
    far = np.concatenate([PLACES, np.ones((50, 1))], axis=1) @ lens.homography.T
    assert lens.project(PLACES) == pytest.approx(far[:, :2] / far[:, 2:], abs=1e-9)


def test_straight_on_it_is_one_scale() -> None:
    lens = Lens(20.0, 832, 640)
    assert lens.straight
    assert lens.project(np.array([0.0, 0.0])).tolist() == [415.5, 319.5]
    assert lens.project(np.array([1.0, 2.0])).tolist() == [435.5, 279.5]
    assert lens.scale(PLACES).tolist() == [20.0] * 50


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (5.0, -4.0), (-15.0, 10.0)])
@pytest.mark.parametrize("k1", [0.0, -0.4, 0.7])
def test_the_local_scale_is_the_root_of_the_area_that_a_small_square_covers(
    tilt: tuple[float, float], k1: float
) -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=tilt, k1=k1)
    step = 1e-4
    right, up = np.array([step, 0.0]), np.array([0.0, step])
    a = (lens.project(PLACES + right) - lens.project(PLACES - right)) / (2 * step)
    b = (lens.project(PLACES + up) - lens.project(PLACES - up)) / (2 * step)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert lens.scale(PLACES) == pytest.approx(np.sqrt(area), rel=1e-7)


@pytest.mark.parametrize(
    ("tilt", "k1"), [((0.0, 0.0), 0.0), ((3.0, -4.0), 0.0), ((-20.0, 12.0), -0.3)]
)
def test_the_camera_is_the_lens_of_the_plates_pictures(tilt: Any, k1: float) -> None:
    camera = BoardCamera(20.0, 1920, 1200, tilt, (k1,), 300.0)
    lens = Lens(20.0, 1920, 1200, tilt_deg=tilt, k1=k1, distance_mm=300.0)
    places = np.array([[10.0, 5.0], [-20.0, -9.0], [0.0, 0.0], [40.0, 25.0]])
    rotation, shift = camera.see(BoardPlace())
    on_board = np.column_stack([places[:, 0], -places[:, 1], 0 * places[:, 0]])
    px = seen(camera, on_board, rotation, shift)
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
    off = px.reshape(-1, 2) - seen(camera, places, rotation, shift)
    assert np.abs(off.mean(axis=0)).max() < 0.05
    assert np.sqrt((off**2).sum(axis=1).mean()) < 0.2


def test_a_board_beside_the_picture_is_not_in_it() -> None:
    camera = BoardCamera(10.0, 320, 200)
    picture = draw_board(camera, BoardPlace((500.0, 0.0, 0.0)), BoardPrint())
    assert np.all(picture == 25)
