"""The longest silence of an event camera: quiet cameras, lost data, pulses that tell them apart."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.quality import longest_silence_s, missing_pulses

HOLD, START, END = 0, 2_000_000, 12_000_000
LIMIT_S = 0.05
NONE = np.empty(0, np.int64)


def events(rate_hz: float, seed: int = 1) -> np.ndarray:
    """Poisson times from the hold to the end, us."""
    rng = np.random.default_rng(seed)
    count = rng.poisson(rate_hz * END * 1e-6)
    return np.sort(rng.integers(HOLD, END, count))


def cut(times: np.ndarray, begin_s: float, seconds: float) -> np.ndarray:
    begin, end = 1e6 * begin_s, 1e6 * (begin_s + seconds)
    return times[(times < begin) | (times >= end)]


def silence(times: np.ndarray, missing: np.ndarray = NONE) -> float:
    return longest_silence_s(times, (HOLD, START, END), missing, LIMIT_S)


@pytest.mark.parametrize("seed", range(20))
def test_a_quiet_camera_loses_nothing_by_being_silent(seed: int) -> None:
    times = events(60.0, seed)
    inside = times[(times >= START) & (times < END)]
    assert np.diff(inside).max() > 1e6 * LIMIT_S  # by chance alone, in nearly every trial
    assert silence(times) <= LIMIT_S


def test_a_silence_of_a_busy_camera_is_a_loss() -> None:
    found = silence(cut(events(3000.0), 5.0, 0.1))
    assert found == pytest.approx(0.1, abs=2e-3)


def test_a_missing_pulse_shows_what_a_quiet_camera_lost() -> None:
    times = cut(events(60.0), 5.0, 0.3)
    assert silence(times) <= LIMIT_S or silence(times) >= 0.3  # 18 events were expected
    shorter = cut(events(60.0), 5.0, 0.1)
    assert silence(shorter) <= LIMIT_S
    assert silence(shorter, np.array([5_050_000_000])) >= 0.1
    assert silence(shorter, np.array([1_000_000_000])) <= LIMIT_S  # in the hold


def test_below_the_limit_the_longest_silence_is_told_at_any_rate() -> None:
    times = np.arange(HOLD, END, 40_000)
    assert silence(times) == pytest.approx(0.04)


def test_a_camera_that_sends_nothing_in_the_motion_is_silent_all_along() -> None:
    times = events(3000.0)
    assert silence(times[times < START]) == pytest.approx(10.0)


def test_pulses_are_missing_where_none_is_near() -> None:
    sent = np.arange(10, dtype=np.int64) * 10_000_000
    reported = np.delete(sent, [3, 7]) + 150_000
    assert missing_pulses(sent, reported).tolist() == [30_000_000, 70_000_000]
    assert missing_pulses(sent, reported[::-1]).tolist() == [30_000_000, 70_000_000]
    assert missing_pulses(sent, NONE).tolist() == sent.tolist()
    assert missing_pulses(sent, sent[:1]).tolist() == sent[1:].tolist()
    assert missing_pulses(NONE, sent).tolist() == []
