"""A watched promise of false alarms: seldom doubted where it is kept, soon where it is not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors.alarms import alarm_times
from sliplab.analysis.detectors.promise_watch import PromiseWatch

RUNS = 400
HOURS = 100.0
HOUR_US = 3_600_000_000


def contradicted_h(rng: np.random.Generator, rate: float, promised: float = 1.0) -> float:
    """Watch Poisson alarms; return when the promise was contradicted, h, or infinity."""
    watch = PromiseWatch(promised)
    before_us = 0
    for at_h in np.sort(rng.uniform(0, HOURS, rng.poisson(rate * HOURS))):
        at_us = round(at_h * HOUR_US)
        watch.add(before_us, at_us, True)
        before_us = at_us
        if watch.broken_h is not None:
            return watch.broken_h
    return float("inf")


@pytest.mark.parametrize("rate", [1.0, 0.5])
def test_a_kept_promise_is_contradicted_in_5_percent_of_runs_at_most(rate: float) -> None:
    rng = np.random.default_rng(1)
    assert np.isfinite([contradicted_h(rng, rate) for _ in range(RUNS)]).mean() <= 0.05


@pytest.mark.parametrize(("rate", "within_h"), [(5.0, 3.0), (20.0, 0.5), (2.0, 30.0)])
def test_a_broken_promise_is_contradicted_in_time(rate: float, within_h: float) -> None:
    rng = np.random.default_rng(2)
    found = np.array([contradicted_h(rng, rate) for _ in range(RUNS)])
    assert (found <= within_h).mean() >= 0.95


def test_time_counts_once_and_an_alarm_lasts_a_second() -> None:
    watch = PromiseWatch(1.0)
    watch.add(0, 30_000, False)
    watch.add(10_000, 40_000, True)  # overlaps
    watch.add(20_000, 50_000, True)
    watch.add(1_000_000, 1_030_000, True)  # after a gap, within the second
    watch.add(1_010_000, 1_040_000, True)
    assert watch.alarms == 2
    assert watch.hours == pytest.approx(90_000 / HOUR_US)
    assert watch.evidence == pytest.approx((1.5**2 + 2**2 + 3**2 + 5**2 + 10**2) / 5, rel=1e-3)
    assert "contradict at most 1 false alarms an hour" in watch.words


@settings(max_examples=50)
@given(st.lists(st.booleans(), max_size=60))
def test_alarms_are_counted_as_where_levels_are_set(above: list[bool]) -> None:
    """At steps of 150 ms: what lasts longer than a second is several."""
    watch, step_us = PromiseWatch(1.0), 150_000
    for k, alarm in enumerate(above):
        watch.add(k * step_us, (k + 1) * step_us, alarm)
    ends_us = (np.flatnonzero(above) + 1).astype(np.int64) * step_us
    assert watch.alarms == len(alarm_times(ends_us))


def test_many_alarms_and_long_times_are_numbers() -> None:
    watch = PromiseWatch(1e6)
    for k in range(2000):
        watch.add(k * 1_000_000, (k + 1) * 1_000_000, True)
    assert watch.evidence < 1e-9
    assert watch.words.startswith("2000 alarms in 0.556 h do not contradict")
    quick = PromiseWatch(1e-3)
    for k in range(2000):
        quick.add(k * 1_000_000, (k + 1) * 1_000_000, True)
    assert quick.broken_h is not None
    assert np.isfinite(quick.evidence)
