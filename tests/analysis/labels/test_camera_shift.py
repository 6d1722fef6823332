"""A common shift of everything that stands still, told from slip."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.labels.camera_shift import camera_shift


def slides(n: int = 200, m: int = 19, noise: float = 0.004) -> np.ndarray:
    """Markers that let go one after the other, the first one last; (n, m, 2)."""
    starts = np.concatenate(([160], np.linspace(40, 130, m - 1)))
    way = 0.3 * np.maximum(0, np.arange(n)[:, None] - starts)
    away = np.stack((way, 0.2 * way), axis=-1)
    result: np.ndarray = away + np.random.default_rng(1).normal(0, noise, away.shape)
    return result


def test_slip_alone_is_no_shift() -> None:
    found = camera_shift(slides())
    assert not found.px.any()
    assert not found.unsure.any()
    assert found.largest_px == 0.0


def test_a_knock_is_found_to_a_hundredth_and_taken_out() -> None:
    away = slides()
    away[70:] += np.array([0.8, -0.6])
    found = camera_shift(away)
    np.testing.assert_allclose(found.px[70:110], [[0.8, -0.6]] * 40, atol=0.01)
    assert np.abs(found.px[:70]).max() < 0.01
    assert not found.unsure.any()


def test_a_trembling_camera_is_followed_while_markers_stand_still() -> None:
    away = slides()
    tremor = np.random.default_rng(2).uniform(-1, 1, (200, 1, 2))
    found = camera_shift(away + tremor)
    np.testing.assert_allclose(found.px[:100], tremor[:100, 0], atol=0.02)
    # and where too few do, that is said
    assert found.unsure[135:].any()
    assert not found.unsure[:100].any()


def test_a_slow_drift_of_the_camera_is_followed() -> None:
    away = slides() + np.linspace(0, 0.5, 200)[:, None, None]
    found = camera_shift(away)
    np.testing.assert_allclose(found.px[100], np.array([0.5, 0.5]) * 100 / 199, atol=0.02)


def test_unseen_markers_say_nothing() -> None:
    away = slides()
    away[50:90, 3:9] = np.nan
    away[120] = np.nan
    assert not camera_shift(away).px.any()
    assert camera_shift(np.full((5, 3, 2), np.nan)).px.shape == (5, 2)


def fast_slides(seed: int, px_per_frame: float = 1.2, stops: float | None = None) -> np.ndarray:
    """Markers that let go within 40 frames, the first one last, in any direction; (200, 19, 2)."""
    rng = np.random.default_rng(seed)
    starts = np.concatenate(([104.0], np.sort(rng.uniform(60, 100, 18))))
    at = np.arange(200.0)
    if stops is not None:  # a ramp of 1.2 frames, as of an arm
        late = np.clip(at - stops, 0.0, 1.2)
        at = np.minimum(at, stops) + late - late**2 / 2.4
    way = px_per_frame * np.maximum(0.0, at[:, None] - starts)
    angle = rng.uniform(0, 2 * np.pi)
    away = np.stack((np.cos(angle) * way, np.sin(angle) * way), axis=-1)
    result: np.ndarray = away + rng.normal(0, 0.0045, away.shape)
    return result


@pytest.mark.parametrize("px_per_frame", [0.32, 0.6, 1.2, 2.0, 4.0])
def test_a_fast_slide_is_no_shift(px_per_frame: float) -> None:
    """Each marker that lets go steps by more than a knock, above 40 px/s."""
    for seed in range(2, 22):
        found = camera_shift(fast_slides(seed, px_per_frame))
        assert not found.px.any(), seed
        assert not found.unsure.any()


@pytest.mark.parametrize("px_per_frame", [0.6, 1.2, 4.0])
def test_a_slide_that_stops_is_no_knock(px_per_frame: float) -> None:
    for seed in range(2, 12):
        assert not camera_shift(fast_slides(seed, px_per_frame, stops=150.3)).px.any(), seed


@pytest.mark.parametrize("frame", [40, 80, 101])
def test_a_knock_in_a_fast_slide_is_found(frame: int) -> None:
    """Before it, while markers let go, and with the centre alone at rest."""
    for seed in range(2, 12):
        away, angle = fast_slides(seed), 0.7 * seed
        knock = np.array([np.cos(angle), np.sin(angle)])
        away[frame:] += knock
        found = camera_shift(away)
        np.testing.assert_allclose(found.px[frame:], [knock] * (200 - frame), atol=0.2)
        assert not found.px[: frame - 1].any() or np.abs(found.px[: frame - 1]).max() < 0.05


def pressed_shallow() -> np.ndarray:
    """The outer twelve papillae do not touch, and move with the sensor from frame 20 on."""
    away = slides()
    away[:, 7:, 0] = 0.3 * np.maximum(0, np.arange(200) - 20)[:, None]
    away[:, 7:, 1] = 0.0
    result: np.ndarray = away
    return result


def test_papillae_that_do_not_touch_are_no_shift_however_many() -> None:
    assert not camera_shift(pressed_shallow()).px.any()


def test_a_knock_is_found_beside_papillae_that_do_not_touch() -> None:
    away = pressed_shallow()
    away[10:] += np.array([0.8, -0.6])
    found = camera_shift(away)
    np.testing.assert_allclose(found.px[10:20], [[0.8, -0.6]] * 10, atol=0.02)
