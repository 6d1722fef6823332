"""The limit of the bench: closed forms, the bound on false alarms, and a slide."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sliplab.plugins.bench.definition import SIZES
from sliplab.plugins.bench.limit import certain_after, level_of, waits_ms, without_slip
from sliplab.plugins.bench.scenes import test_scenes as scenes_of


@pytest.mark.parametrize("rate", [0.3, 2.0, 15.2])
def test_silence_is_certain_when_the_missing_events_reach_the_level(rate: float) -> None:
    nothing, slid = np.zeros((1, 200)), np.full((1, 200), 1e-9)
    (found,) = certain_after(nothing, slid, np.full((1, 200), rate), [1.0])
    # a step without an event says exp(-slid) against exp(-rate); 3.6 million steps an hour
    assert found == math.ceil(math.log(3.6e6) / (rate - 1e-9))


def test_events_as_before_never_are() -> None:
    rates = np.full((2, 200), 2.0)
    assert certain_after(rates, rates, rates, [1.0, 1000.0]) == [math.inf, math.inf]


def test_more_alarms_an_hour_are_certain_earlier() -> None:
    nothing, slid, stuck = np.zeros((1, 99)), np.full((1, 99), 0.01), np.full((1, 99), 0.5)
    waits = certain_after(nothing, slid, stuck, [1.0, 10.0, 100.0])
    assert waits == sorted(waits, reverse=True)
    assert waits[0] > waits[2]


def test_pages_test_at_the_level_is_false_as_seldom_as_stated() -> None:
    # Lorden's bound, where steps are independent: Page's statistic under no slip
    rng = np.random.default_rng(3)
    slid, stuck, per_hour = 0.4, 2.0, 3600e3 / 300  # one in 300 steps at the most
    ratio = np.log(slid / stuck) * rng.poisson(stuck, 300_000) - (slid - stuck)
    level, evidence, alarms = level_of(per_hour), 0.0, 0
    for step in ratio:
        evidence = max(0.0, evidence + step)
        if evidence >= level:
            alarms, evidence = alarms + 1, 0.0
    # a thousand are allowed; the level's overshoot makes them fewer
    assert 100 < alarms < 1000


def test_without_its_slip_a_tip_is_dragged_on() -> None:
    t_ns = np.arange(-100, 101) * 1_000_000
    drag = 0.02 * np.minimum(t_ns, 0) * 1e-6
    rows = np.tile(np.column_stack([drag, -2.0 * drag, np.full(201, 0.3)]), 2)
    found = without_slip(t_ns, rows, 1, 0)
    np.testing.assert_array_equal(found[:, :3], rows[:, :3])
    np.testing.assert_allclose(found[:, 3], 0.02 * t_ns * 1e-6, atol=1e-12)
    np.testing.assert_allclose(found[:, 4], -0.04 * t_ns * 1e-6, atol=1e-12)
    np.testing.assert_array_equal(found[:, 5], rows[:, 5])


@pytest.mark.long
def test_of_a_slide_it_is_milliseconds_and_repeats() -> None:
    drawn = scenes_of(SIZES["small"], 5, "usual")[:3]
    waits = [waits_ms(slide, [1.0, 100.0]) for slide in drawn]
    assert all(2.0 <= late[1] <= late[0] <= 60.0 for late in waits)
    assert waits_ms(drawn[0], [1.0, 100.0]) == waits[0]
