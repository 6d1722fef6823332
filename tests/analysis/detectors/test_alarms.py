"""Alarms above a level, and the level of a rate of false ones."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.detectors.alarms import (
    SceneEvidence,
    alarm_times,
    level_at,
    outcome,
    promised_levels,
)
from sliplab.analysis.detectors.detector import Evidence, Slip

SLIP = Slip(5_000_000, 5_100_000, 8_000_000)


def judged(*pairs: tuple[float, float], slip: Slip = SLIP) -> SceneEvidence:
    """Evidence of (seconds, value)."""
    t_s, value = zip(*pairs, strict=True)
    return SceneEvidence(Evidence.of(np.round(1e6 * np.array(t_s)), value), slip)


def test_an_alarm_lasts_a_second() -> None:
    t_us = np.array([0, 10, 999_999, 1_000_000, 1_500_000, 2_000_001], np.int64)
    assert alarm_times(t_us).tolist() == [0, 1_000_000, 2_000_001]


def test_the_first_alarm_between_the_slips_onset_and_gross_slip_detects_it() -> None:
    found = outcome(judged((1.0, 9), (4.0, 1), (5.2, 2), (5.3, 9)), 1)
    assert (found.false, found.detected_us, found.early) == (1, 5_200_000, False)
    assert outcome(judged((4.0, 1), (8.0, 9)), 1).detected_us is None


@pytest.mark.parametrize("before_s", [4.0001, 4.999])
def test_an_alarm_that_lasts_until_the_slip_has_not_detected_it(before_s: float) -> None:
    found = outcome(judged((before_s, 9), (5.0, 9), (5.9, 9)), 1)
    assert (found.false, found.detected_us, found.early) == (1, None, True)


def test_a_level_is_the_lowest_that_keeps_the_alarms() -> None:
    rng = np.random.default_rng(3)
    scenes = []
    for _ in range(5):
        t_s = np.sort(rng.uniform(0, 8, 60))
        scenes.append(judged(*zip(t_s, rng.integers(0, 40, 60), strict=True)))

    def alarms(level: float) -> int:
        return sum(outcome(scene, level).false for scene in scenes)

    for allowed in (0, 1, 3, 12):
        # brute force over all whole numbers and what is between them
        least = min(level for level in np.arange(-1, 41, 0.5) if alarms(level) <= allowed)
        found = level_at(scenes, allowed)
        assert found == least
        assert alarms(found) <= allowed < alarms(found - 0.5)


def test_nothing_bounds_the_level_of_a_detector_without_false_alarms() -> None:
    assert level_at([judged((5.5, 1.0))], 0) == -np.inf


def worlds_with_alarms(
    rng: np.random.Generator, worlds: int, hours: float, shape: float
) -> list[SceneEvidence]:
    """Draw worlds whose rates above a level u are gamma times exp(-u), 300 an hour in mean."""
    found = []
    slip_us = round(3.6e9 * hours / worlds)
    for world in range(worlds):
        rate = 300 * rng.gamma(shape) / shape
        t_us = np.unique(rng.integers(0, slip_us, rng.poisson(rate * hours / worlds)))
        evidence = Evidence.of(t_us, rng.exponential(size=len(t_us)))
        found.append(SceneEvidence(evidence, Slip(slip_us, slip_us, slip_us), str(world)))
    return found


@pytest.mark.long
@pytest.mark.parametrize("draws", [20, 400])
@pytest.mark.parametrize("shape", [1.0, 100.0])
def test_a_promise_is_kept_in_new_worlds(draws: int, shape: float) -> None:
    rates = (1.0, 10.0, 30.0)
    rng = np.random.default_rng(7)
    broken = np.zeros(len(rates))
    for _ in range(draws):
        levels = promised_levels(worlds_with_alarms(rng, 130, 4.3, shape), rates)
        assert all(level.promised for level in levels)
        assert np.all(np.diff([level.value for level in levels]) <= 0)
        broken += [300 * np.exp(-level.value) > level.asked for level in levels]
    # 5 % of the draws, and three standard deviations of so many draws
    assert (broken <= 0.05 * draws + 3 * np.sqrt(0.05 * draws)).all()


def test_a_rate_that_the_hours_cannot_show_is_not_promised() -> None:
    rng = np.random.default_rng(1)
    one, more = promised_levels(worlds_with_alarms(rng, 30, 0.5, 1.0), (1.0, 30.0))
    assert not one.promised, "half an hour without an alarm allows 7 an hour"
    assert one.found.alarms == 0
    assert one.words == (
        "a rate of 1 an hour cannot be promised: 0.5 h without slip bound it at 7.38 an hour; "
        "it takes 3.69 h without an alarm"
    )
    assert more.promised
    assert more.found.alarms > 0
    assert more.value < one.value
