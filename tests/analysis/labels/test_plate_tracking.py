"""The plate's marker on drawn frames, alone and above the papillae, seen, hidden and falling."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.labels import plate_tracking
from sliplab.analysis.labels.blobs import find_blobs
from sliplab.analysis.labels.plate_tracking import (
    MAX_BRIDGED,
    PlatePose,
    PlateTrack,
    PlateTracker,
    bridge,
)
from tests.patching import loose

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]

SHAPE = (420, 480)
SIDE = 72.0


@cache
def sheet(marker_id: int) -> Frame:
    """The printed marker with a quiet zone of one cell, 20 px a cell."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    return np.pad(
        cv2.aruco.generateImageMarker(dictionary, marker_id, 120), 20, constant_values=255
    )


def corners_of(centre: Floats, angle: float = 0.0, side: float = SIDE) -> Floats:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    unit = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
    return np.asarray(centre) + side * unit @ turn.T


def stick(
    frame: Frame, centre: Floats, angle: float = 0.0, marker_id: int = 7, side: float = SIDE
) -> Frame:
    """The marker drawn onto a frame, each pixel the mean of 4 x 4 samples."""
    fine = 4
    printed = sheet(marker_id)
    height, width = frame.shape
    # edges of the pixel grid of the sheet, -0.5 outwards from pixel centres
    edge = np.array([[19.5, 19.5], [139.5, 19.5], [139.5, 139.5], [19.5, 139.5]], np.float32)
    there = (corners_of(centre, angle, side) + 0.5) * fine - 0.5
    warp = cv2.getPerspectiveTransform(edge, there.astype(np.float32))
    size = (width * fine, height * fine)
    ink = cv2.warpPerspective(printed, warp, size, flags=cv2.INTER_LINEAR)
    cover = cv2.warpPerspective(np.full_like(printed, 255), warp, size, flags=cv2.INTER_LINEAR)

    def shrunk(image: Frame) -> Floats:
        parts = image.reshape(height, fine, width, fine)
        mean: Floats = parts.mean(axis=(1, 3)) / 255
        return mean

    alpha, value = shrunk(cover), shrunk(ink)
    drawn = frame * (1 - alpha) + 20 * alpha + 200 * value
    return np.clip(np.round(drawn), 0, 255).astype(np.uint8)


def dark() -> Frame:
    return np.full(SHAPE, 25, np.uint8)


def noisy(frame: Frame, rng: np.random.Generator) -> Frame:
    return np.clip(np.round(frame + rng.normal(0, 1.5, frame.shape)), 0, 255).astype(np.uint8)


def track_plate(frames: Iterable[Frame], max_bridged: int = MAX_BRIDGED) -> PlateTrack:
    """The plate's marker through a video; see `PlateTracker` and `bridge`."""
    tracker = PlateTracker()
    return bridge([tracker.update(frame) for frame in frames], max_bridged)


@pytest.mark.quick(1)
@pytest.mark.parametrize("angle", [0.0, 0.1, 2.0])
def test_corners_and_centre_to_a_tenth_of_a_pixel(angle: float) -> None:
    rng = np.random.default_rng(1)
    centres = np.array([300.0, 120.0]) + rng.uniform(-1, 1, (12, 2))
    track_ = track_plate([noisy(stick(dark(), at, angle), rng) for at in centres])
    assert track_.ok.all()
    assert np.sqrt(np.mean((track_.xy - centres) ** 2)) < 0.1
    # clockwise from the marker's own top left, whichever way it is turned
    truth = np.stack([corners_of(at, angle) for at in centres])
    assert np.abs(track_.corners - truth).max() < 0.5


def test_a_plate_that_falls_is_followed() -> None:
    # 9.81 m/s² at 14 px/mm and 100 frames/s is 13.7 px a frame, every frame
    drop = np.concatenate((np.zeros(3), 0.5 * 13.7 * np.arange(6) ** 2))
    centres = np.array([200.0, 70.0]) + np.stack((np.zeros(9), drop), axis=-1)
    track_ = track_plate([stick(dark(), at) for at in centres])
    assert track_.ok.all()
    assert np.abs(track_.xy - centres).max() < 0.2


def test_a_jump_across_the_frame_is_found() -> None:
    centres = np.array([[100.0, 80.0], [101.0, 80.0], [380.0, 330.0], [380.5, 330.0]])
    track_ = track_plate([stick(dark(), at) for at in centres])
    assert np.abs(track_.xy - centres).max() < 0.2


@pytest.mark.long
def test_short_gaps_are_bridged_and_flagged() -> None:
    centres = np.array([150.0, 100.0]) + np.arange(30)[:, None] * np.array([2.0, 1.0])
    frames = [stick(dark(), at) for at in centres]
    hidden = np.zeros(30, np.bool_)
    hidden[[0, 1, 5, 8, 9, 10, 11, 12, 14, 15, 16, 17, 18, 19, 29]] = True
    seen = [dark() if lost else frame for frame, lost in zip(frames, hidden, strict=True)]
    track_ = track_plate(seen)
    np.testing.assert_array_equal(track_.ok, ~hidden)
    unknown = np.zeros(30, np.bool_)
    unknown[[0, 1, 14, 15, 16, 17, 18, 19, 29]] = True  # six in a row, and the ends
    np.testing.assert_array_equal(np.isnan(track_.xy).any(axis=1), unknown)
    assert np.abs(track_.xy - centres)[~unknown].max() < 0.2
    assert np.isnan(track_plate(seen, max_bridged=0).xy[hidden]).all()
    assert np.abs(track_plate(seen, max_bridged=6).xy - centres)[2:29].max() < 0.2


def test_a_bridge_is_straight() -> None:
    def pose(at: float) -> PlatePose:
        return PlatePose(True, corners_of(np.array([at, 0.0])), 0.01)

    lost = plate_tracking.UNSEEN
    track_ = bridge([pose(0.0), lost, lost, lost, pose(8.0)])
    np.testing.assert_allclose(track_.xy[:, 0], [0, 2, 4, 6, 8], atol=1e-12)
    np.testing.assert_allclose(track_.corners[2], corners_of(np.array([4.0, 0.0])), atol=1e-12)
    assert np.isnan(bridge([lost, lost]).xy).all()
    assert bridge([]).corners.shape == (0, 4, 2)


def test_the_first_marker_stays_the_marker() -> None:
    both = stick(stick(dark(), np.array([120.0, 90.0])), np.array([350.0, 300.0]), 0.0, 3, 48.0)
    other = stick(dark(), np.array([120.0, 90.0]), 0.0, 3)
    track_ = track_plate([both, other, both])
    assert track_.ok.tolist() == [True, False, True]  # the larger one, and no other in its place
    np.testing.assert_allclose(track_.xy[0], [120, 90], atol=0.2)


def test_a_video_in_one_pass() -> None:
    rng = np.random.default_rng(3)
    angle = 2 * np.pi * np.arange(6) / 6
    layout = 56 * np.concatenate((np.zeros((1, 2)), np.stack((np.cos(angle), np.sin(angle)), -1)))
    frames, plates, markers = [], [], []
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    for i in range(12):
        at = np.array([180.0 + 0.4 * i, 300.0]) + layout
        frame = np.full(SHAPE, 25.0)
        for x, y in at:
            frame += 175 * np.clip(20.5 - np.hypot(columns - x, rows - y), 0, 1)
        plates.append(np.array([340.0, 80.0 + 3.0 * i]))
        markers.append(at)
        frames.append(noisy(stick(frame.astype(np.uint8), plates[-1], 0.05), rng))
    tracks = plate_tracking.track_video(iter(frames), layout, with_plate=True)
    assert tracks.plate.ok.all()
    assert tracks.markers.ok.all()
    assert np.abs(tracks.plate.xy - plates).max() < 0.2
    assert np.abs(tracks.markers.xy - markers).max() < 0.1
    # the same as each alone
    np.testing.assert_array_equal(tracks.plate.corners, track_plate(frames).corners)
    without = plate_tracking.track_video(frames, layout, with_plate=False)
    assert without.plate is None
    np.testing.assert_array_equal(without.markers.xy, tracks.markers.xy)


@pytest.mark.parametrize("marker_id", [0, 7, 17, 23, 49])
def test_no_part_of_the_plate_is_taken_for_a_papilla(marker_id: int) -> None:
    for angle in (0.0, 0.4):
        frame = stick(dark(), np.array([240.0, 200.0]), angle, marker_id, 200.0)
        assert len(find_blobs(frame).xy) == 0


def test_nothing_and_the_wrong_thing() -> None:
    pose = PlateTracker().update(dark())
    assert not pose.seen
    assert np.isnan(pose.centre).all()
    assert np.isnan(pose.corners).all()
    assert track_plate([]).xy.shape == (0, 2)
    with pytest.raises(TypeError, match="uint8"):
        loose(PlateTracker()).update(np.zeros(SHAPE))


def test_a_quiet_zone_on_a_dark_ground_is_not_the_marker() -> None:
    """The white card is a square, too: at OpenCV's default distance it hid the marker inside."""
    for side in (60, 90, 108):
        module = side // 6
        marker = cv2.aruco.generateImageMarker(
            cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), 0, 6 * module
        )
        card = np.full((8 * module, 8 * module), 255, np.uint8)
        card[module:-module, module:-module] = marker
        frame = np.full((512, 512), 25, np.uint8)
        frame[20 : 20 + 8 * module, 350 : 350 + 8 * module] = np.where(card > 127, 200, 25)
        pose = PlateTracker().update(frame)
        assert pose.seen
        expected = np.array([350, 20]) + (8 * module - 1) / 2
        assert np.abs(pose.centre - expected).max() < 0.5
