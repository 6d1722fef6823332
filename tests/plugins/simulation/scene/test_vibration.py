"""Tremor of the arm: its bounds, its frequencies, and what it belongs to."""

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.vibration import ArmVibration

T_NS = np.arange(20_000, dtype=np.int64) * 1_000_000


def test_it_stays_within_its_peak_and_band() -> None:
    trembling = ArmVibration(15.0, 5.0, rig_seed=1, trial_seed=2)
    moved = trembling.at(T_NS)
    assert trembling
    assert moved.shape == (20_000, 3)
    assert np.abs(moved).max() <= 0.015
    power = np.abs(np.fft.rfft(moved, axis=0)) ** 2
    hz = np.fft.rfftfreq(20_000, 1e-3)
    inside = (hz > 3.4) & (hz < 6.6)
    assert np.all(power[inside].sum(axis=0) > 0.98 * power[1:].sum(axis=0))


def test_tones_are_the_rigs_and_phases_the_trials() -> None:
    first, again = (ArmVibration(15.0, 5.0, 1, 2).at(T_NS) for _ in range(2))
    assert np.array_equal(first, again)
    other = ArmVibration(15.0, 5.0, 1, 3).at(T_NS)
    assert not np.allclose(first, other)
    spectra = [np.argmax(np.abs(np.fft.rfft(m[:, 0]))) for m in (first, other)]
    assert spectra[0] == pytest.approx(spectra[1], abs=40)


def test_trials_tremble_from_not_at_all_to_the_peak() -> None:
    peaks = [np.abs(ArmVibration(15.0, 5.0, 1, seed).at(T_NS)).max() for seed in range(60)]
    # largest values of two sines come within a per cent of their sum in 20 s
    assert max(peaks) > 0.013
    assert min(peaks) < 0.002
    assert np.mean(peaks) == pytest.approx(0.0075, rel=0.2)


def test_without_amplitude_there_is_none() -> None:
    still = ArmVibration(0.0, 5.0, 1, 2)
    assert not still
    assert np.all(still.at(T_NS) == 0.0)
