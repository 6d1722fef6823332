"""A common shift of everything that stands still, told from slip."""

from __future__ import annotations

import numpy as np

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
