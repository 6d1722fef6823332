"""Marker tracking in hard cases, and the accuracy of the stated standard deviation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sliplab.analysis.labels.markers import MarkerTracks
from tests.analysis.labels.reference_tracks import reference_track
from tests.analysis.labels.test_markers import (
    CENTRE,
    LAYOUT,
    RADIUS,
    SIZE,
    draw,
    still,
    track,
    video,
)

GLIDE = np.arange(40)[:, None, None] * np.array([0.31, -0.17])


def off(tracks: MarkerTracks, truth: np.ndarray) -> np.ndarray:
    """Larger error of a marker's two coordinates, px, NaN where it was lost."""
    return np.abs(tracks.xy - truth).max(axis=2)


def test_it_agrees_with_threshold_and_blobs_and_its_error_is_as_stated() -> None:
    truth = still(40) + GLIDE
    frames = video(truth)
    tracks = track(frames, LAYOUT)
    apart = tracks.xy - reference_track(frames, LAYOUT)
    assert np.sqrt(np.mean(apart**2)) < 0.02
    # normalised errors have a root mean square of one, give or take what the grid does
    z = (tracks.xy - truth) / tracks.sigma[..., None]
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert tracks.quality.min() > 0.9


def test_the_reference_loses_what_is_hidden_and_finds_it_again() -> None:
    truth = still(6)
    frames = video(truth)
    frames[2][250:310, 250:310] = 25
    found = reference_track(frames, LAYOUT)
    assert np.isnan(found[2, 0]).all()
    assert np.isfinite(np.delete(found, 2, axis=0)).all()
    assert reference_track([], LAYOUT).shape == (0, 19, 2)


@pytest.mark.quick(1)
@pytest.mark.parametrize("level", [20.0, 60.0])
def test_glare_is_followed_or_owned_up_to(level: float) -> None:
    """A soft reflection that stands still while the skin moves under it."""
    truth = still(40) + GLIDE
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    light = level * np.exp(-((columns - 300) ** 2 + (rows - 270) ** 2) / (2 * 45.0**2))
    frames = [cv2.add(frame, light.astype(np.uint8)) for frame in video(truth)]
    tracks = track(frames, LAYOUT)
    assert tracks.ok.all()
    assert (off(tracks, truth) < 5 * tracks.sigma + 0.04).all()


def test_a_burst_of_glare_loses_the_marker_or_owns_up() -> None:
    truth = still(20)
    frames = video(truth)
    for frame in frames[8:12]:
        frame[265:330, 262:330] = np.maximum(frame[265:330, 262:330], 180)
    tracks = track(frames, LAYOUT)
    away = off(tracks, truth)
    assert not tracks.ok[8:12, 0].any()
    assert tracks.ok[12:].all()
    assert np.nanmax(away) < 0.1


def test_motion_blur_moves_no_centre() -> None:
    """Ten places along an exposure in which the skin goes 8 px."""
    truth = still(7)
    truth[4:] += np.array([0.3, 0.1])
    frames = video(truth)
    for i in range(4, 7):
        along = np.linspace(-4.0, 4.0, 10)
        smeared = [draw(truth[i] + np.array([s, 0.5 * s]), RADIUS).astype(float) for s in along]
        frames[i] = np.mean(smeared, axis=0).round().astype(np.uint8)
    tracks = track(frames, LAYOUT)
    assert tracks.ok.all()
    assert off(tracks, truth).max() < 0.1


def test_low_contrast_is_followed_with_a_larger_error() -> None:
    truth = still(15) + GLIDE[:15]
    rng = np.random.default_rng(9)
    tracks = track([draw(at, RADIUS, rng, bright=80.0) for at in truth], LAYOUT)
    assert tracks.ok.all()
    assert off(tracks, truth).max() < 0.1
    bright = track(video(truth), LAYOUT)
    assert np.median(tracks.sigma) > np.median(bright.sigma)


def test_a_torn_papilla_is_lost_for_good_and_nothing_takes_its_name() -> None:
    truth = still(40) + GLIDE
    rng = np.random.default_rng(5)
    frames = [
        draw(np.delete(at, 3, axis=0) if i >= 10 else at, RADIUS, rng) for i, at in enumerate(truth)
    ]
    tracks = track(frames, LAYOUT)
    assert not tracks.ok[10:, 3].any()
    assert np.delete(tracks.ok, 3, axis=1).all()
    assert np.nanmax(off(tracks, truth)) < 0.05
    assert not tracks.quality[10:, 3].any()


def test_a_marker_that_leaves_the_picture_is_not_measured_there() -> None:
    away = np.arange(30) * 2.5
    truth = still(30) - np.stack((away, np.zeros(30)), axis=-1)[:, None] - np.array([120.0, 0.0])
    tracks = track(video(truth), LAYOUT)
    gone = truth[:, :, 0] < RADIUS - 1
    assert gone.any()
    assert not tracks.ok[gone].any()
    assert np.nanmax(off(tracks, truth)) < 0.05
    assert CENTRE[0] > 0
