"""Drawn pictures must say where things are to a few thousandths of a pixel, and nothing else."""

from typing import Any

import numpy as np
import pytest
from scipy.integrate import quad

from sliplab.analysis.labels.plate_tracking import PlateTracker
from sliplab.plugins.simulation.scene.frames import (
    ExposurePath,
    Exposures,
    FrameOptics,
    PlateView,
    Reflections,
    draw_reflections,
    expose,
    moved,
)
from sliplab.plugins.simulation.scene.skin import SkinGeometry, make_skin

SKIN = make_skin(SkinGeometry(), 1)
SIZE = 832
HALF = 0.5 * (SIZE - 1)


def draw(
    optics: FrameOptics,
    tips: np.ndarray,
    plate: float | None = None,
    number: int = 0,
    size: tuple[int, int] = (SIZE, SIZE),
    seed: int = 1,
    way: ExposurePath | None = None,
) -> np.ndarray:
    image = np.full((1, size[1], size[0]), 77, np.uint8)
    height = None if plate is None else np.array([plate])
    ways = None if way is None else {0: way}
    PlateView(optics, *size).draw(image, tips[None], height, np.array([number]), seed, ways)
    return image[0]


def corners_of(image: np.ndarray) -> np.ndarray:
    tracker = PlateTracker()
    seen, corners, _ = tracker.update(image)
    assert seen
    assert tracker.marker_id == 0
    return corners


def centroid(image: np.ndarray, ground: int) -> tuple[float, float, float]:
    """Column, row and summed grey of everything above the ground."""
    weight = image.astype(float) - ground
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    total = weight.sum()
    return (weight * columns).sum() / total, (weight * rows).sum() / total, total


@pytest.mark.parametrize("offset", [(0.0, 0.0), (0.37, -0.21), (-0.5, 0.499)])
def test_centroids_are_where_the_tips_are(offset: tuple[float, float]) -> None:
    optics = FrameOptics(noise=0.0, px_per_mm=12.0, tip_radius_mm=2.0)
    tips = SKIN.layout_mm + np.array(offset) / optics.px_per_mm
    image = draw(optics, tips, size=(512, 512)).astype(float) - optics.ground_level
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
    assert rows.mean() == pytest.approx(HALF - 300, abs=0.05)
    assert columns.mean() == pytest.approx(HALF + 200, abs=0.05)


def test_the_ground_is_even_away_from_the_markers_and_noisy_near_them() -> None:
    image = draw(FrameOptics(), np.array([[0.0, 0.0]]))
    assert np.all(image[:380, :] == 25)
    assert image[405:427, 405:427].std() == pytest.approx(1.5, rel=0.2)
    assert image[391:395, 391:440].std() > 0.5


def test_noise_belongs_to_the_frame_and_the_trial() -> None:
    tips = SKIN.layout_mm
    first = draw(FrameOptics(), tips, 0.0, number=7)
    assert np.array_equal(first, draw(FrameOptics(), tips, 0.0, number=7))
    assert not np.array_equal(first, draw(FrameOptics(), tips, 0.0, number=8))
    assert not np.array_equal(first, draw(FrameOptics(), tips, 0.0, number=7, seed=2))


def test_a_picture_does_not_depend_on_what_is_drawn_with_it() -> None:
    optics, rng = FrameOptics(), np.random.default_rng(1)
    tips = SKIN.layout_mm + rng.normal(0.0, 0.2, (5, len(SKIN), 2))
    heights, number = np.linspace(0.0, -2.0, 5), np.arange(5)
    way = {
        3: ExposurePath(
            tips[3] + np.linspace(-0.1, 0.1, 9)[:, None, None], heights[3] + np.zeros(9)
        )
    }
    whole = np.empty((5, SIZE, SIZE), np.uint8)
    PlateView(optics, SIZE, SIZE).draw(whole, tips, heights, number, 1, way)
    for k in range(5):
        one = draw(optics, tips[k], heights[k], number=k, way=way.get(k))
        assert np.array_equal(one, whole[k])


def test_discs_may_leave_the_picture_even_smeared() -> None:
    optics = FrameOptics()
    tips = np.array([[21.0, 0.0], [-21.7, 3.0], [0.0, 21.5], [500.0, 500.0], [5.0, -20.9]])
    image = draw(optics, tips)
    assert image[416, SIZE - 1] > 150
    assert image.max() < 210
    assert image.min() > 15
    path = tips + np.linspace(-1.0, 1.0, 41)[:, None, None]
    smeared = draw(optics, tips, way=ExposurePath(path, np.zeros(41)))
    assert smeared.max() < 215
    assert smeared.min() > 15


@pytest.mark.long
@pytest.mark.parametrize("length_px", [0.15, 0.6, 2.7, 28.0])
@pytest.mark.parametrize("angle", [0.0, 0.5, np.pi / 2])
def test_a_smeared_disc_is_the_mean_of_sharp_ones(length_px: float, angle: float) -> None:
    optics = FrameOptics(noise=0.0)
    along = np.array([np.cos(angle), np.sin(angle)]) * length_px / optics.px_per_mm
    start = np.array([[0.013, -0.027]])
    count = 32 if length_px < 8 else 128
    shares = (np.arange(count) + 0.5) / count
    path = start + shares[:, None, None] * along
    size = (96, 96)
    drawn = draw(optics, path.mean(axis=0), size=size, way=ExposurePath(path, np.zeros(count)))
    # brute force: 64 whole pictures, summed
    total = np.zeros(size)
    for share in (np.arange(64) + 0.5) / 64:
        total += draw(optics, start + share * along, size=size)
    assert np.abs(drawn - total / 64).max() <= 1.0
    x, y, weight = centroid(drawn, optics.ground_level)
    expected = PlateView(optics, *size).centre_px(start + 0.5 * along)[0]
    # grey levels are whole numbers: over a smeared disc that is a few thousandths of a pixel
    assert (x, y) == pytest.approx(tuple(expected), abs=0.003)
    assert weight == pytest.approx(175 * np.pi * 20.0**2, rel=2e-3)


def test_a_smeared_plate_marker_is_the_mean_of_sharp_ones() -> None:
    optics = FrameOptics(noise=0.0)
    nothing = np.empty((0, 2))
    heights = -3.0 - (np.arange(112) + 0.5) / 112 * 1.4
    way = ExposurePath(np.empty((112, 0, 2)), heights)
    drawn = draw(optics, nothing, heights.mean(), way=way)
    total = np.zeros((SIZE, SIZE))
    for share in (np.arange(64) + 0.5) / 64:
        total += draw(optics, nothing, -3.0 - 1.4 * share)
    assert np.abs(drawn - total / 64).max() <= 1.5
    assert drawn.max() > 150


@pytest.mark.parametrize("px_per_mm", [10.3, 12.0, 20.0])
def test_the_aruco_marker_is_found_where_the_plate_is(px_per_mm: float) -> None:
    optics = FrameOptics(px_per_mm=px_per_mm)
    size = (int(43 * px_per_mm),) * 2
    centres = []
    for fallen in (0.0, -0.013, -3.7, -24.9):
        image = draw(optics, SKIN.layout_mm, fallen, size=size)
        corners = corners_of(image)
        side = np.linalg.norm(corners[1] - corners[0])
        assert side == pytest.approx(6.0 * px_per_mm, abs=1.5)
        centres.append(corners.mean(axis=0))
    moved = np.array(centres) - centres[0]
    assert moved[:, 0] == pytest.approx(np.zeros(4), abs=0.15)
    assert moved[:, 1] == pytest.approx(px_per_mm * np.array([0.0, 0.013, 3.7, 24.9]), abs=0.15)
    place = PlateView(optics, *size).centre_px(np.array(optics.marker_centre_mm))
    assert centres[0] == pytest.approx(place, abs=0.6)


@pytest.mark.parametrize("tilt", [(5.0, 0.0), (0.0, -5.0), (3.5, 3.5)])
@pytest.mark.parametrize("k1", [0.0, -0.3])
def test_a_tilted_marker_is_found_where_the_lens_puts_it(tilt: Any, k1: float) -> None:
    optics = FrameOptics(tilt_deg=tilt, k1=k1)
    view = PlateView(optics, SIZE, SIZE)
    half = 0.5 * optics.marker_side_mm
    square = half * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])
    for fallen in (0.0, -8.3, -24.0):
        image = draw(optics, SKIN.layout_mm, fallen)
        found = corners_of(image)
        true = view.centre_px(square + optics.marker_centre_mm + np.array([0.0, fallen]))
        assert found.mean(axis=0) == pytest.approx(true.mean(axis=0), abs=0.15)
        assert found == pytest.approx(true, abs=0.5)


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (5.0, -4.0)])
def test_the_marker_is_clear_of_the_skin_and_inside_the_default_picture(tilt: Any) -> None:
    optics = FrameOptics(noise=0.0, tilt_deg=tilt)
    without, with_marker = draw(optics, SKIN.layout_mm), draw(optics, SKIN.layout_mm, 0.0)
    rows, columns = np.nonzero(without != with_marker)
    assert rows.min() > 0
    assert columns.max() < SIZE - 1
    changed = without[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    assert np.all(changed == optics.ground_level)


@pytest.mark.parametrize("fallen", [-5.0, -16.6, -25.0])
def test_the_marker_falls_past_the_skin_and_not_over_it(fallen: float) -> None:
    optics = FrameOptics(noise=0.0)
    tips = SKIN.layout_mm + np.array([0.3, 0.0])
    without, with_marker = draw(optics, tips), draw(optics, tips, fallen)
    assert np.all(without[without != with_marker] == optics.ground_level)


def test_a_marker_below_the_picture_is_no_trouble() -> None:
    optics = FrameOptics()
    assert np.array_equal(draw(optics, SKIN.layout_mm, -60.0), draw(optics, SKIN.layout_mm, None))
    edge = draw(optics, SKIN.layout_mm, -37.0)
    assert edge[-1, -200:].max() > 150


PX_PER_MM = 20.0
EXPOSURE_NS = 2_000_000


def seen(x_mm, mid_ns: list[int], plate_mm=None) -> Exposures:  # type: ignore[no-untyped-def]
    """Two tips, of which the second stands; places given as functions of the time in ms."""

    def look(t_ns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        ms = t_ns / 1e6
        places = np.zeros((len(ms), 2, 2))
        places[:, 0, 0] = x_mm(ms)
        places[:, 1] = 5.0
        return places, np.zeros(len(ms)) if plate_mm is None else plate_mm(ms)

    return expose(look, np.array(mid_ns, np.int64), EXPOSURE_NS, PX_PER_MM)


MOTIONS = {
    "slow slide": lambda ms: 1.6e-3 * ms,
    "fast slide": lambda ms: 0.7 * ms,
    "fall": lambda ms: 0.5 * 9.81e-3 * ms**2,
    "kink": lambda ms: 0.06 * np.maximum(ms - 9.4, 0.0),
    "late kink": lambda ms: 0.3 * np.maximum(ms - 10.93, 0.0),
    "small kink": lambda ms: 0.004 * np.maximum(ms - 9.7, 0.0),
    "there and back": lambda ms: 0.05 * np.abs(ms - 10.2),
    "standing": lambda ms: 0.0 * ms,
}


@pytest.mark.parametrize("name", MOTIONS)
def test_the_mean_is_the_mean_over_the_exposure(name: str) -> None:
    motion = MOTIONS[name]
    found = seen(motion, [10_000_000])
    corners = [9.4, 9.7, 10.2, 10.93]
    mean = quad(motion, 9.0, 11.0, points=corners, epsabs=1e-12)[0] / 2.0
    assert abs(found.tips_mm[0, 0, 0] - mean) * PX_PER_MM < 0.003
    assert found.tips_mm[0, 1].tolist() == [5.0, 5.0]


def test_only_what_moves_a_tenth_of_a_pixel_has_a_way() -> None:
    # at 1.6 mm/s 0.064 px in 2 ms; at 3 mm/s 0.12 px
    assert not seen(lambda ms: 1.6e-3 * ms, [10_000_000, 20_000_000]).paths
    found = seen(lambda ms: np.where(ms < 15, 0.0, 3e-3 * (ms - 15)), [10_000_000, 20_000_000])
    assert list(found.paths) == [1]
    assert len(found.paths[1].tips_mm) == 32
    path = PX_PER_MM * found.paths[1].tips_mm
    assert moved(path).tolist() == [True, False]


def test_a_falling_plate_alone_is_a_way_too() -> None:
    found = seen(MOTIONS["standing"], [10_000_000], lambda ms: -0.5 * ms)
    assert found.plate_mm[0] == pytest.approx(-5.0, abs=1e-9)
    # 20 px in steps of a quarter
    assert len(found.paths[0].plate_mm) == 80
    assert not moved(PX_PER_MM * found.paths[0].tips_mm).any()


def test_no_frames_are_no_exposures() -> None:
    found = seen(MOTIONS["fall"], [])
    assert found.tips_mm.shape == (0, 2, 2)
    assert not found.paths


@pytest.mark.parametrize("name", MOTIONS)
def test_exposures_seen_together_are_those_seen_one_by_one(name: str) -> None:
    mids = [5_000_000, 8_000_000, 10_000_000, 13_000_000, 40_000_000]
    together = seen(MOTIONS[name], mids, lambda ms: -0.01 * ms)
    for index, mid in enumerate(mids):
        alone = seen(MOTIONS[name], [mid], lambda ms: -0.01 * ms)
        assert np.array_equal(together.tips_mm[index], alone.tips_mm[0])
        assert together.plate_mm[index] == alone.plate_mm[0]
        assert (index in together.paths) == (0 in alone.paths)
        if index in together.paths:
            assert np.array_equal(together.paths[index].tips_mm, alone.paths[0].tips_mm)


NOTHING = np.empty((2, 0, 2))


def test_they_belong_to_the_trial_and_are_soft() -> None:
    some = Reflections(count=6, level=20.0)
    light = draw_reflections(some, 400, 300, 20.0, seed=5).astype(int)
    assert light.shape == (300, 400)
    assert 10 <= light.max() <= 20
    assert light.min() == 0
    # soft: a Gaussian of 7 px or more rises by at most 0.61 / 7 of its height a pixel, six overlap
    assert np.abs(np.diff(light, axis=0)).max() <= 6
    assert np.array_equal(light, draw_reflections(some, 400, 300, 20.0, seed=5))
    assert not np.array_equal(light, draw_reflections(some, 400, 300, 20.0, seed=6))


@pytest.mark.parametrize("reflections", [Reflections(), Reflections(count=3, level=0.0)])
def test_switched_off_they_change_nothing(reflections: Reflections) -> None:
    plain, with_none = (np.empty((2, 200, 200), np.uint8) for _ in range(2))
    tips = np.zeros((2, 1, 2))
    PlateView(FrameOptics(), 200, 200).draw(plain, tips, None, np.arange(2), 1)
    optics = FrameOptics(reflections=reflections)
    PlateView(optics, 200, 200).draw(with_none, tips, None, np.arange(2), 1)
    assert np.array_equal(plain, with_none)


def test_every_picture_of_a_trial_shows_the_same_ones_and_white_stays_white() -> None:
    optics = FrameOptics(reflections=Reflections(count=8, level=90.0), noise=0.0)
    images = np.empty((2, 300, 300), np.uint8)
    view = PlateView(optics, 300, 300)
    view.draw(images, NOTHING, None, np.arange(2), 1)
    assert np.array_equal(images[0], images[1])
    assert images.max() > 25 + 40
    view.draw(images, np.zeros((2, 1, 2)), None, np.arange(2), 1)
    assert images.max() <= 255
    assert images[0, 150, 150] >= 200
