"""Marker tracks on drawn discs whose centres are known, through all that can hide or move them."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.labels.blobs import find_blobs, match_layout
from sliplab.analysis.labels.markers import MarkerTracker, MarkerTracks
from sliplab.analysis.labels.plate_tracking import track_video

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8]

SIZE = (560, 560)
CENTRE = np.array([280.0, 280.0])


def track(frames: list[Frame], layout_px: Floats) -> MarkerTracks:
    return track_video(frames, layout_px, with_plate=False).markers


def skin(px_per_mm: float) -> Floats:
    """Centre, 6 and 12 papillae at 5.6 mm, relative to the centre."""
    places = [(0.0, 0.0)]
    for ring, count in ((1, 6), (2, 12)):
        angle = 2 * np.pi * np.arange(count) / count
        radius = 5.6 * ring
        places += list(zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))
    return np.array(places) * px_per_mm


def draw(
    centres: Floats,
    radius: float,
    rng: np.random.Generator | None = None,
    shape: tuple[int, int] = SIZE,
    bright: float = 200.0,
) -> Frame:
    """Discs of `bright` on 25, each pixel the mean of 5 x 5 samples, noise near them only."""
    frame = np.full(shape, 25.0)
    sub = (np.arange(5) - 2) / 5
    for x, y in centres:
        reach = radius + 8
        left, right = int(max(0, x - reach)), int(min(shape[1], x + reach + 1))
        top, bottom = int(max(0, y - reach)), int(min(shape[0], y + reach + 1))
        if left >= right or top >= bottom:
            continue
        dx = ((np.arange(left, right) - x)[:, None] + sub).ravel()
        dy = ((np.arange(top, bottom) - y)[:, None] + sub).ravel()
        inside = dx[None, :] ** 2 + dy[:, None] ** 2 <= radius**2
        cover = inside.reshape(bottom - top, 5, right - left, 5).mean(axis=(1, 3))
        frame[top:bottom, left:right] += (bright - 25) * cover
        if rng is not None:
            frame[top:bottom, left:right] += rng.normal(0, 1.5, cover.shape)
    return np.clip(np.round(frame), 0, 255).astype(np.uint8)


LAYOUT = skin(10.0)
RADIUS = 20.0


def video(truth: Floats, seed: int = 0) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return [draw(centres, RADIUS, rng) for centres in truth]


def still(n: int) -> Floats:
    return np.broadcast_to(CENTRE + LAYOUT, (n, *LAYOUT.shape)).copy()


@pytest.mark.quick(1)
@pytest.mark.parametrize("px_per_mm", [12.0, 20.0])
def test_centres_to_a_hundredth_of_a_pixel(px_per_mm: float) -> None:
    rng = np.random.default_rng(1)
    layout = skin(px_per_mm)
    shape = (int(30 * px_per_mm),) * 2
    scatter = rng.normal(0, 0.1 * px_per_mm, layout.shape)
    slide = np.arange(12)[:, None, None] * np.array([0.37, -0.21])
    truth = np.array(shape) / 2 + layout + scatter + slide
    tracks = track([draw(at, 2 * px_per_mm, rng, shape) for at in truth], layout)
    assert tracks.xy.shape == (12, 19, 2)
    assert tracks.ok.all()
    assert np.sqrt(np.mean((tracks.xy - truth) ** 2)) < 0.01
    assert np.abs(tracks.xy - truth).max() < 0.05


@pytest.mark.parametrize("speed", [5.0, 12.0])
def test_names_are_kept_at_speed(speed: float) -> None:
    """From rest to `speed` px a frame at once, and back without slowing down."""
    places = speed * np.concatenate((np.zeros(3), np.arange(1, 5), np.arange(3, -4, -1)))
    truth = still(len(places)) + places[:, None, None] * np.array([0.6, 0.8])
    tracks = track(video(truth), LAYOUT)
    assert tracks.ok.all()
    assert np.abs(tracks.xy - truth).max() < 0.05


def test_every_marker_on_its_own_way() -> None:
    rng = np.random.default_rng(2)
    truth = still(30) + np.clip(np.cumsum(rng.normal(0, 2, (30, 19, 2)), axis=0), -5, 5)
    tracks = track(video(truth), LAYOUT)
    assert tracks.ok.all()
    assert np.abs(tracks.xy - truth).max() < 0.15


@pytest.mark.quick(1)
@pytest.mark.parametrize("gap", [6.0, 1.0, 0.0])
def test_neighbours_may_come_close_enough_to_touch(gap: float) -> None:
    truth = still(40)
    truth[:, 1:, 0] -= np.clip(np.arange(40) * 0.6, 0, 56 - 40 - gap)[:, None]
    tracks = track(video(truth), LAYOUT)
    assert tracks.ok.all()
    assert np.sqrt(np.mean((tracks.xy - truth) ** 2)) < 0.05
    assert np.abs(tracks.xy - truth).max() < 0.2


def test_hidden_markers_are_lost_and_found_again() -> None:
    truth = still(30) + np.arange(30)[:, None, None] * np.array([0.8, 0.0])
    frames = video(truth)
    for frame in frames[8:20]:
        frame[256:304, 262:430] = 25
    tracks = track(frames, LAYOUT)
    hidden = np.zeros((30, 19), np.bool_)
    hidden[8:20, [0, 1, 7]] = True
    np.testing.assert_array_equal(tracks.ok, ~hidden)
    np.testing.assert_array_equal(np.isnan(tracks.xy).any(axis=2), hidden)
    assert np.abs((tracks.xy - truth)[tracks.ok]).max() < 0.05


def test_a_half_hidden_marker_is_lost_rather_than_moved() -> None:
    clear, *frames = video(still(11))
    for i, frame in enumerate(frames):
        frame[:, int(CENTRE[0]) + 20 - 5 * i : int(CENTRE[0]) + 22][258:302] = 25
    tracks = track([clear, *frames], LAYOUT)
    error = np.hypot(*(tracks.xy[:, 0] - CENTRE).T)
    assert np.nanmax(error) < 2.0
    assert not tracks.ok[6:, 0].any()
    assert tracks.ok[:, 1:].all()
    # and while it is not lost, what is said of its error holds
    off = np.abs(tracks.xy - (CENTRE + LAYOUT)).max(axis=2)
    assert np.nanmax(off - 5 * tracks.sigma) < 0.05


def test_the_camera_covered_for_a_while() -> None:
    truth = still(30)
    truth[15:] += np.array([12.0, -9.0])
    frames = video(truth)
    for frame in frames[10:20]:
        frame[:] = 25
    tracks = track(frames, LAYOUT)
    dark = np.zeros(30, np.bool_)
    dark[10:20] = True
    np.testing.assert_array_equal(tracks.ok, np.broadcast_to(~dark[:, None], (30, 19)))
    assert np.abs((tracks.xy - truth)[~dark]).max() < 0.05


@pytest.mark.long
def test_out_over_the_edge_and_back() -> None:
    away = np.concatenate((np.arange(40), np.arange(40)[::-1])) * 3.7
    truth = still(80) - np.stack((away, np.zeros(80)), axis=-1)[:, None] - np.array([135.0, 0])
    tracks = track(video(truth), LAYOUT)
    edge = truth[:, :, 0] - RADIUS
    assert not tracks.ok[edge < -0.5].any()
    assert tracks.ok[edge > 2.5].all()
    assert tracks.ok[40].sum() < 10 < tracks.ok[-1].sum()
    assert np.abs((tracks.xy - truth)[tracks.ok]).max() < 0.05


def test_markers_that_appear_later() -> None:
    truth = still(12) + np.arange(12)[:, None, None] * np.array([0.5, 0.5])
    rng = np.random.default_rng(4)
    frames = [
        draw(np.delete(at, [0, 7], axis=0) if i < 6 else at, RADIUS, rng)
        for i, at in enumerate(truth)
    ]
    tracks = track([np.full(SIZE, 25, np.uint8), frames[0], *frames[1:]], LAYOUT)
    assert not tracks.ok[0].any()
    np.testing.assert_array_equal(tracks.ok[1:, [0, 7]].all(axis=1), np.arange(12) >= 6)
    assert np.abs((tracks.xy[1:] - truth)[tracks.ok[1:]]).max() < 0.05


def test_nothing_is_found_where_nothing_is() -> None:
    rng = np.random.default_rng(5)
    for frame in (
        np.zeros(SIZE, np.uint8),
        np.full(SIZE, 255, np.uint8),
        rng.integers(0, 256, SIZE).astype(np.uint8),
        draw(CENTRE + LAYOUT, RADIUS, rng, bright=45.0),
    ):
        assert not track([frame, frame], LAYOUT).ok.any()
    tracks = track([], LAYOUT)
    assert tracks.xy.shape == (0, 19, 2)
    assert tracks.ok.shape == (0, 19)


def test_names_come_from_the_layout() -> None:
    rng = np.random.default_rng(6)
    for _ in range(20):
        shift = rng.uniform(-200, 200, 2)
        places = LAYOUT + shift + rng.normal(0, 1.0, LAYOUT.shape)
        order = rng.permutation(19)
        kept = order[: rng.integers(13, 20)]
        junk = rng.uniform(-600, 600, (rng.integers(0, 30), 2))
        junk = junk[(np.hypot(*(junk[:, None] - places).T) > 25).all(axis=0)]
        found, index = match_layout(np.concatenate((places[kept], junk)), LAYOUT, 0.35 * 56)
        expected = np.full(19, -1)
        expected[kept] = np.arange(len(kept))
        np.testing.assert_array_equal(index, expected)
        np.testing.assert_allclose(found, shift, atol=2.0)
    _, index = match_layout(np.empty((0, 2)), LAYOUT, 20.0)
    assert (index == -1).all()


def test_blobs_are_round_and_of_the_right_size() -> None:
    frame = draw(np.array([[60.3, 70.6], [150.0, 80.0]]), 20.0)
    frame[200:236, 200:236] = 200  # a square
    frame[300:310, 40:150] = 200  # a bar
    frame[400:500, 400:500] = 200
    frame[405:495, 405:495] = 25  # a hollow square
    frame[520:523, 20:23] = 200  # a speck
    blobs = find_blobs(frame)
    order = np.argsort(blobs.xy[:, 0])
    np.testing.assert_allclose(blobs.xy[order], [[60.3, 70.6], [150.0, 80.0]], atol=0.03)
    np.testing.assert_allclose(blobs.area, np.pi * 400, rtol=0.02)
    np.testing.assert_allclose(blobs.roundness, 1.0, atol=0.005)
    assert len(find_blobs(frame, min_area_px=2_000).xy) == 0
    assert len(find_blobs(frame, max_area_px=1_000).xy) == 0


def test_a_layout_of_one() -> None:
    truth = np.array([[[100.0 + 2 * i, 90.0]] for i in range(8)])
    frames = [draw(at, RADIUS, shape=(200, 200)) for at in truth]
    tracks = track(frames, np.zeros((1, 2)))
    assert np.abs(tracks.xy - truth).max() < 0.05


def test_strided_and_read_only_frames() -> None:
    frame = draw(CENTRE + LAYOUT, RADIUS)
    wide = np.zeros((SIZE[0], 2 * SIZE[1]), np.uint8)
    wide[:, ::2] = frame
    frame.flags.writeable = False
    tracks = track([wide[:, ::2], frame, frame], LAYOUT)
    assert tracks.ok.all()


def test_wrong_input_is_named() -> None:
    frame = draw(CENTRE + LAYOUT, RADIUS)
    tracker = MarkerTracker(LAYOUT)
    for bad in (frame.astype(np.float32), np.stack([frame] * 3, axis=-1)):
        with pytest.raises(TypeError, match="uint8"):
            tracker.update(bad)
    with pytest.raises(ValueError, match="layout_px"):
        MarkerTracker(np.zeros((19, 3)))
    with pytest.raises(ValueError, match="too near"):
        MarkerTracker(np.zeros((19, 2)))
