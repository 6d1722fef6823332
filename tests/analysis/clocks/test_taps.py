"""Clocks by taps: two simulated sensors, what must be refused, and how often intervals hold."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from sliplab.analysis.clocks.pulse_match import NoMatchError
from sliplab.analysis.clocks.taps import TapMap, find_taps, map_by_taps
from sliplab.storage.streams import F64, I64

TRIALS = 200
PPM = 300.0


@dataclass(frozen=True)
class Sensor:
    """A sensor of taps: its rate, how its signal rises (a power of time), its peak in noises."""

    rate_hz: float
    power: float
    rise_s: float
    peak: float
    axes: int = 1

    def signal(self, taps_s: F64, end_s: float, rng: np.random.Generator) -> tuple[F64, F64]:
        """Return true times of samples, and their values."""
        t = np.arange(rng.uniform(0, 1 / self.rate_hz), end_s, 1 / self.rate_hz)
        t = t + rng.uniform(-0.1, 0.1, t.size) / self.rate_hz
        values = rng.normal(size=(t.size, self.axes)) + rng.normal(0, 50, self.axes)
        for tap in taps_s:
            since = np.maximum(t - tap, 0.0)
            up = np.minimum((since / self.rise_s) ** self.power, 1.0)
            down = np.exp(-np.maximum(since - self.rise_s, 0.0) / 0.02)
            ring = np.where(since > self.rise_s, np.cos(200 * (since - self.rise_s)), 1.0)
            values[:, 0] += self.peak * up * down * ring
        return t, values


def some_sensor(rng: np.random.Generator) -> Sensor:
    return Sensor(
        rate_hz=float(rng.choice([100.0, 500.0, 1000.0, 5000.0])),
        power=float(rng.uniform(0.7, 2.0)),
        rise_s=float(rng.uniform(0.001, 0.02)),
        peak=float(rng.uniform(60, 3000)),
        axes=int(rng.choice([1, 3])),
    )


def stamps(true_s: F64, offset_s: float, ppm: float) -> I64:
    return np.rint((true_s * (1 + ppm * 1e-6) + offset_s) * 1e9).astype(np.int64)


def two_clocks(rng: np.random.Generator, taps_s: F64, end_s: float) -> tuple[TapMap, bool, float]:
    """Return the map, whether it holds at taps and a minute away, and the half-width at a tap."""
    ppm, offset = rng.uniform(-PPM, PPM), rng.uniform(-1e4, 1e4)
    found = []
    for clock in ((0.0, 0.0), (offset, ppm)):
        true, values = some_sensor(rng).signal(taps_s, end_s, rng)
        found.append(find_taps("A", stamps(true, *clock), values))
    result = map_by_taps(found[0], found[1], PPM)
    at = np.concatenate([taps_s, taps_s[-1:] + 60.0])
    low, high = result.bounds(stamps(at, 0.0, 0.0))
    true_ns = stamps(at, offset, ppm)
    return result, bool(((low <= true_ns) & (true_ns <= high)).all()), (high[0] - low[0]) / 2e9


@pytest.mark.quick(1)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_truth_lies_within_the_interval(count: int) -> None:
    rng, held, halves = np.random.default_rng(count), [], []
    for _ in range(TRIALS):
        taps = 0.5 + np.arange(count) * 2.0 + rng.uniform(0, 1, count)
        try:
            result, holds, half = two_clocks(rng, taps, taps[-1] + 0.5)
        except NoMatchError:  # few samples fell into a tap
            continue
        assert result.taps == count
        held.append(holds)
        halves.append(half)
    assert len(held) >= 0.9 * TRIALS
    assert np.mean(held) >= 0.95
    assert np.median(halves) < 0.03


def tapped(taps_s: list[float], rng: np.random.Generator, **more: float) -> tuple[I64, F64]:
    sensor = Sensor(**{"rate_hz": 1000.0, "power": 1.0, "rise_s": 0.003, "peak": 500.0, **more})
    true, values = sensor.signal(np.array(taps_s), 10.0, rng)
    return stamps(true, 5.0, 0.0), values


def test_what_cannot_be_trusted_is_refused() -> None:
    rng = np.random.default_rng(1)
    once, twice = (find_taps("A", *tapped(at, rng)) for at in ([2.0], [2.0, 5.0]))
    late = find_taps("A", *tapped([2.0, 5.2], rng))
    for a, b, near, reason in (
        (twice, once, None, "ambiguous"),
        (twice, late, None, "no_match"),  # the second one is another event in B
        (twice, twice, (0, 4 * 10**9), "ambiguous"),
        (once, once, (10**9, 10**8), "no_match"),
    ):
        with pytest.raises(NoMatchError) as refusal:
            map_by_taps(a, b, PPM, near)
        assert refusal.value.reason == reason
    assert map_by_taps(twice, once, PPM, (0, 10**9)).taps == 1


@pytest.mark.parametrize(
    ("taps", "more", "text"),
    [
        ([], {}, "no clear tap"),
        ([2.0], {"peak": 20.0}, "no clear tap"),
        ([2.0], {"rise_s": 0.5}, "which is no tap"),
        ([0.002], {}, "is not quiet"),
    ],
)
def test_a_signal_without_a_clear_tap_is_refused(
    taps: list[float], more: dict[str, float], text: str
) -> None:
    with pytest.raises(NoMatchError, match=text):
        find_taps("B", *tapped(taps, np.random.default_rng(2), **more))


def test_a_value_that_is_no_number_is_a_fault() -> None:
    t_ns, values = tapped([2.0], np.random.default_rng(3))
    values[7] = np.nan
    with pytest.raises(ValueError, match="not a finite number"):
        find_taps("B", t_ns, values)
