"""Drawn pictures must say where things are to a few thousandths of a pixel, and nothing else."""

import cv2
import numpy as np
import pytest

from rigs.scene.frames import FrameOptics, PlateView
from rigs.scene.skin import SkinGeometry, make_skin

SKIN = make_skin(SkinGeometry(), 1)


def draw(
    optics: FrameOptics, tips: np.ndarray, plate: float | None = None, number: int = 0,
    size: tuple[int, int] = (512, 512), seed: int = 1,
) -> np.ndarray:  # fmt: skip
    image = np.full((1, size[1], size[0]), 77, np.uint8)
    height = None if plate is None else np.array([plate])
    PlateView(optics, *size).draw(image, tips[None], height, np.array([number]), seed)
    return image[0]


def corners_of(image: np.ndarray) -> np.ndarray:
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    found, ids, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    assert ids is not None
    assert ids.ravel().tolist() == [0]
    return np.asarray(found[0][0])


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.37, -0.21), (-0.5, 0.499)])
def test_centroids_are_where_the_tips_are(offset: tuple[float, float]) -> None:
    optics = FrameOptics(noise=0.0)
    tips = SKIN.layout_mm + np.array(offset) / optics.px_per_mm
    image = draw(optics, tips).astype(float) - optics.ground_level
    for x, y in PlateView(optics, 512, 512).centre_px(tips):
        rows, columns = np.mgrid[int(y) - 29 : int(y) + 31, int(x) - 29 : int(x) + 31]
        weight = image[rows, columns]
        assert (weight * columns).sum() / weight.sum() == pytest.approx(x, abs=0.001)
        assert (weight * rows).sum() / weight.sum() == pytest.approx(y, abs=0.001)
        area = weight.sum() / (optics.tip_level - optics.ground_level)
        assert area == pytest.approx(np.pi * 24.0**2, rel=2e-3)


def test_up_in_the_world_is_up_in_the_picture_and_right_is_right() -> None:
    image = draw(FrameOptics(noise=0.0), np.array([[10.0, 15.0]]))
    rows, columns = np.nonzero(image > 100)
    assert rows.mean() == pytest.approx(255.5 - 180, abs=0.05)
    assert columns.mean() == pytest.approx(255.5 + 120, abs=0.05)


def test_the_ground_is_even_away_from_the_markers_and_noisy_near_them() -> None:
    image = draw(FrameOptics(), np.array([[0.0, 0.0]]))
    assert np.all(image[:200, :] == 25)
    assert image[250:262, 250:262].std() == pytest.approx(1.5, rel=0.2)
    assert image[227:231, 227:231].std() > 0.5


def test_noise_belongs_to_the_frame_and_the_trial() -> None:
    tips = SKIN.layout_mm
    first = draw(FrameOptics(), tips, number=7)
    assert np.array_equal(first, draw(FrameOptics(), tips, number=7))
    assert not np.array_equal(first, draw(FrameOptics(), tips, number=8))
    assert not np.array_equal(first, draw(FrameOptics(), tips, number=7, seed=2))


def test_discs_may_leave_the_picture() -> None:
    optics = FrameOptics()
    tips = np.array([[21.0, 0.0], [-22.9, 3.0], [0.0, 23.0], [500.0, 500.0], [5.0, -21.4]])
    image = draw(optics, tips)
    assert image[256, 511] > 150
    assert image.max() < 210
    assert image.min() > 15


@pytest.mark.parametrize("px_per_mm", [10.3, 12.0, 17.3])
def test_the_aruco_marker_is_found_where_the_plate_is(px_per_mm: float) -> None:
    optics = FrameOptics(px_per_mm=px_per_mm)
    size = (int(43 * px_per_mm),) * 2
    centres = []
    for fallen in (0.0, -0.013, -3.7, -24.9):
        image = draw(optics, SKIN.layout_mm, fallen, size=size)
        corners = corners_of(image)
        side = np.linalg.norm(corners[1] - corners[0])
        assert side == pytest.approx(6.6 * px_per_mm, abs=1.5)
        centres.append(corners.mean(axis=0))
    moved = np.array(centres) - centres[0]
    assert moved[:, 0] == pytest.approx(np.zeros(4), abs=0.15)
    assert moved[:, 1] == pytest.approx(px_per_mm * np.array([0.0, 0.013, 3.7, 24.9]), abs=0.15)
    place = PlateView(optics, *size).centre_px(np.array(optics.marker_centre_mm))
    assert centres[0] == pytest.approx(place, abs=0.6)


def test_the_marker_is_clear_of_the_skin_and_inside_the_default_picture() -> None:
    optics = FrameOptics(noise=0.0)
    without, with_marker = draw(optics, SKIN.layout_mm), draw(optics, SKIN.layout_mm, 0.0)
    rows, columns = np.nonzero(without != with_marker)
    assert rows.min() > 0
    assert columns.max() < 511
    changed = without[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert np.all(changed == optics.ground_level)


def test_a_marker_below_the_picture_is_no_trouble() -> None:
    optics = FrameOptics()
    assert np.array_equal(draw(optics, SKIN.layout_mm, -60.0), draw(optics, SKIN.layout_mm, None))
    draw(optics, SKIN.layout_mm, -37.0)
