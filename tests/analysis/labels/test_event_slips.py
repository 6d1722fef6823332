"""Slips of papillae whose markers follow the sensor in closed form, up to a knee."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.labels.event_slips import PapillaSlips, slips

STEP_S, STILL = 0.005, 100
PLAY_PX = 0.3


def trial(
    knee_mm: float,
    *,
    speed: float = 1.0,
    gain: float = 3.0,
    after: float = 0.0,
    noise_px: float = 0.02,
    tremor_mm: float = 0.0,
    length_mm: float = 6.0,
) -> PapillaSlips:
    """One papilla that sticks up to a knee and then follows by a share `after` of its gain.

    Its gain falls by a tenth over the way, as a bent papilla's does.
    """
    t = STEP_S * np.arange(round(length_mm / speed / STEP_S))
    way = np.concatenate([np.zeros(STILL), speed * t])
    true = way.copy()
    true[STILL:] += tremor_mm * np.sin(2 * np.pi * 5.0 * t)
    stuck = np.minimum(true, knee_mm)
    px = gain * (stuck - 0.1 * stuck**2 / (2 * length_mm))
    px += after * gain * np.maximum(true - knee_mm, 0.0)
    px += np.random.default_rng(3).normal(0.0, noise_px, len(px))
    sigma = np.full((len(px), 1), max(noise_px, 0.01))
    return slips(way[:, None], px[:, None], sigma, STILL, PLAY_PX)


@pytest.mark.parametrize("speed", [0.6, 1.6])
@pytest.mark.parametrize("knee_mm", [0.2, 1.0, 4.0])
def test_a_knee_is_found_within_its_interval(knee_mm: float, speed: float) -> None:
    found = trial(knee_mm, speed=speed, gain=5.0 if knee_mm < 1 else 3.0)
    assert found.low_mm[0] <= knee_mm <= found.high_mm[0]
    assert found.knee_mm[0] == pytest.approx(knee_mm, abs=0.02)
    assert found.high_mm[0] - found.low_mm[0] < 0.12
    # from then on all of the sensor's way is slip
    way = np.concatenate([np.zeros(STILL), speed * STEP_S * np.arange(len(found.distance_mm))])
    slid = np.maximum(way[: len(found.distance_mm)] - knee_mm, 0.0)
    off = np.abs(found.distance_mm[:, 0] - slid)
    assert off[slid < 0.5].max() < 0.05


def test_a_papilla_that_never_slips_has_no_knee() -> None:
    found = trial(np.inf)
    assert np.isnan(found.knee_mm[0])
    assert np.abs(found.distance_mm).max() < 0.05
    assert found.gain[0] == pytest.approx(2.73, rel=0.05)


@pytest.mark.parametrize("speed", [0.6, 1.0, 1.6])
def test_the_arms_tremor_is_no_slip(speed: float) -> None:
    found = trial(np.inf, speed=speed, tremor_mm=0.015)
    assert np.isnan(found.knee_mm[0])
    found = trial(3.0, speed=speed, tremor_mm=0.015)
    assert found.knee_mm[0] == pytest.approx(3.0, abs=0.04)
    assert found.sigma_mm[STILL + 50, 0] > 0.005


def test_a_slip_that_sets_in_slowly_is_found() -> None:
    found = trial(2.0, after=0.45)
    assert found.knee_mm[0] == pytest.approx(2.0, abs=0.08)
    # it slides by what the marker lacks: 55 % of the way
    late = found.distance_mm[STILL + round(2.5 / STEP_S), 0]
    assert late == pytest.approx(0.275, abs=0.05)


def test_once_it_slips_the_play_of_the_track_is_part_of_its_deviation() -> None:
    found = trial(2.0)
    assert found.sigma_mm[STILL + round(1.5 / STEP_S), 0] < 0.015
    assert found.sigma_mm[-1, 0] > PLAY_PX / np.sqrt(12) / 3.0


def test_a_base_that_hardly_moves_does_not_slip() -> None:
    """The centre of a twist."""
    way = np.linspace(0.0, 0.1, 1000)[:, None]
    found = slips(way, np.zeros((1000, 1)), np.full((1000, 1), 0.02), 0, PLAY_PX)
    assert np.isnan(found.knee_mm[0])
    assert (found.distance_mm == 0.0).all()
    assert (found.sigma_mm <= 0.1).all()


def test_a_marker_that_is_unknown_has_no_slip() -> None:
    way = np.linspace(0.0, 6.0, 1000)[:, None]
    unknown = np.full((1000, 1), np.nan)
    found = slips(way, unknown, np.full((1000, 1), 0.02), 100, PLAY_PX)
    assert np.isnan(found.distance_mm).all()
    assert np.isnan(found.knee_mm).all()
    # one that never follows shows nothing either, as nobody knows what is missing
    still = np.zeros((1000, 1))
    assert np.isnan(slips(way, still, np.full((1000, 1), 0.02), 100, PLAY_PX).distance_mm).all()
