"""Clock fits on trains with every fault a real one has, and the trains that must be refused."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.clocks.clocks import ClockFit, ClockRefused, fit_clock
from tests.patching import loose

TICK_NS = 10_000_000
DAY_NS = 86_400 * 10**9

Ints = NDArray[np.int64]


def code(ticks: int, state: int) -> NDArray[np.bool_]:
    """The sync box's 16-bit LFSR, taps 16, 14, 13, 11."""
    bits = np.empty(ticks, np.bool_)
    for i in range(ticks):
        bits[i] = state & 1
        feedback = (state ^ (state >> 2) ^ (state >> 3) ^ (state >> 5)) & 1
        state = (state >> 1) | (feedback << 15)
    return bits


@dataclass
class Trains:
    device: Ints
    reference: Ints
    true_device: Ints


def trains(
    rng: np.random.Generator,
    seconds: float,
    ppm: float = 0.0,
    offset_ns: int = 0,
    jitter_ns: float = 5_000.0,
    missing: float = 0.02,
    double: float = 0.01,
    late: float = 0.02,
    spurious: float = 0.01,
) -> Trains:
    """A box's pulses as a device with all its faults stamps them, in whole microseconds."""
    bits = code(int(seconds * 1e9 / TICK_NS), int(rng.integers(1, 1 << 16)))
    reference = np.flatnonzero(bits).astype(np.int64) * TICK_NS
    true = np.round(reference / (1 + ppm * 1e-6)).astype(np.int64)
    seen = true + np.round(rng.normal(0, jitter_ns, true.size)).astype(np.int64)
    behind = rng.random(seen.size) < late
    seen[behind] += rng.integers(50_000, 5_000_000, int(behind.sum()))
    seen = seen[rng.random(seen.size) >= missing]
    again = seen[rng.random(seen.size) < double]
    stray = rng.integers(0, int(seconds * 1e9), int(spurious * seen.size))
    seen = np.concatenate((seen, again + rng.integers(0, 50_000, again.size), stray))
    device = (seen + offset_ns) // 1000 * 1000
    start = int(rng.integers(0, 10**12)) * 1000
    return Trains(np.sort(device), reference + start, true + offset_ns)


def worst_error(fit: ClockFit, made: Trains) -> int:
    return int(np.abs(fit.map.to_reference(made.true_device) - made.reference).max())


@pytest.mark.parametrize("seconds", [3, 10, 60])
@pytest.mark.parametrize("ppm", [0.0, 100.0, -100.0, 5_000.0, -5_000.0])
@pytest.mark.parametrize("offset_ns", [0, -3 * DAY_NS, 20_000 * DAY_NS, 2**62])
def test_a_faulty_train_is_fitted_to_a_few_microseconds(
    seconds: int, ppm: float, offset_ns: int
) -> None:
    made = trains(np.random.default_rng([seconds, int(ppm) % 99_991]), seconds, ppm, offset_ns)
    fit = fit_clock(made.device, made.reference)
    # sigma / sqrt(n) at the ends, and the cut to whole microseconds
    assert worst_error(fit, made) < (5_000 if seconds == 3 else 3_000)
    assert fit.drift_ppm == pytest.approx(ppm, abs=3 / seconds + 1e-3)
    assert fit.peak_ratio < 0.85
    assert fit.residual_median_ns < 5_000
    assert fit.residual_p95_ns < 15_000
    assert fit.uncertainty_ns < 5_000


@pytest.mark.long
def test_the_stated_uncertainty_holds() -> None:
    rng = np.random.default_rng(7)
    held, count = 0, 400
    for _ in range(count):
        made = trains(rng, 6, float(rng.uniform(-100, 100)), int(rng.integers(0, 2**60)))
        fit = fit_clock(made.device, made.reference, max_drift_ppm=200)
        held += worst_error(fit, made) <= fit.uncertainty_ns
    assert 0.925 <= held / count <= 0.975  # 95 %, and 2.3 standard deviations of chance


def test_every_pulse_is_accounted_for() -> None:
    clean = trains(np.random.default_rng(3), 20, 0, 0, 2_000, 0, 0, 0, 0)
    fit = fit_clock(clean.device, clean.reference)
    assert (fit.pulses_seen, fit.pulses_late) == (clean.reference.size, 0)
    assert (fit.pulses_missed, fit.pulses_spurious) == (0, 0)
    faulty = np.delete(clean.device, np.arange(50, 60))
    faulty[100:107] += 2_000_000
    faulty = np.concatenate((faulty, faulty[200:205] + 30_000))
    fit = fit_clock(faulty, clean.reference)
    assert (fit.pulses_missed, fit.pulses_late, fit.pulses_spurious) == (10, 7, 5)
    assert fit.pulses_seen == clean.reference.size - 17


def test_perfect_stamps_give_the_exact_line() -> None:
    bits = code(3_000, 0xACE1)
    device = np.flatnonzero(bits).astype(np.int64) * TICK_NS + 2**62
    reference = (device - 2**62) + (device - 2**62) // 10_000 + 17  # 100 ppm, exactly
    fit = fit_clock(device, reference, resolution_ns=0)
    assert fit.map.drift_ppm() == pytest.approx(100.0, abs=1e-6)
    assert np.abs(fit.map.to_reference(device) - reference).max() <= 1
    assert fit.residual_max_ns < 1


def test_a_short_recording_is_found_in_a_long_one() -> None:
    rng = np.random.default_rng(11)
    made = trains(rng, 60, 50.0, 10**17)
    start = made.true_device[0]
    inside = (made.device - start > 40 * 10**9) & (made.device - start < 43 * 10**9)
    fit = fit_clock(made.device[inside], made.reference)
    truth = (made.true_device - start > 40 * 10**9) & (made.true_device - start < 43 * 10**9)
    error = fit.map.to_reference(made.true_device[truth]) - made.reference[truth]
    assert np.abs(error).max() < 4_000
    # and the other way round, where the device saw more than the box reported
    late = (made.reference - made.reference[0] > 38 * 10**9) & truth.any()
    fit = fit_clock(made.device, made.reference[late])
    error = fit.map.to_reference(made.true_device[truth]) - made.reference[truth]
    assert np.abs(error).max() < 4_000


def test_two_spurious_pulses_for_every_true_one() -> None:
    made = trains(np.random.default_rng(5), 10, 80.0, 10**15, missing=0.1, late=0.1, spurious=2.0)
    assert worst_error(fit_clock(made.device, made.reference), made) < 4_000


def test_stray_stamps_from_another_age_change_nothing() -> None:
    made = trains(np.random.default_rng(6), 10, 30.0, 10**16)
    fit = fit_clock(made.device, made.reference)
    strays = np.append(made.device, [-(2**63), 0, 2**62, 2**63 - 1])
    expected = fit.map.to_reference(made.true_device)
    for device, reference in (
        (strays, made.reference),
        (made.device, np.append(made.reference, 2**62)),
    ):
        again = fit_clock(device, reference).map.to_reference(made.true_device)
        assert np.abs(again - expected).max() <= 1


def test_order_of_the_stamps_does_not_matter() -> None:
    rng = np.random.default_rng(8)
    made = trains(rng, 6, 30.0, 10**16)
    shuffled = rng.permutation(made.device)
    assert fit_clock(shuffled, made.reference) == fit_clock(made.device, made.reference)


def test_irregular_intervals_are_a_code_too() -> None:
    rng = np.random.default_rng(9)
    reference = np.cumsum(rng.integers(5_000_000, 20_000_000, 500)).astype(np.int64)
    fit = fit_clock(reference + 10**14, reference, resolution_ns=0)
    assert fit.map.to_reference(10**14) == 0


def test_an_arm_that_samples_at_500_hz() -> None:
    made = trains(np.random.default_rng(10), 30, 60.0, 10**15, jitter_ns=0)
    held = -(-made.device // 2_000_000) * 2_000_000
    fit = fit_clock(held, made.reference, jitter_ns=1e6, resolution_ns=2e6, rounding="up")
    # at 60 ppm the 10 ms grid and the 2 ms grid stay locked for 33 s, which is the millisecond
    # stated: no fit can see where in the 2 ms they are
    error = fit.map.to_reference(made.true_device) - made.reference
    assert np.abs(error).max() <= fit.uncertainty_ns < 1_500_000


def refused(device: Ints, reference: Ints, **limits: float) -> str:
    with pytest.raises(ClockRefused) as caught:
        fit_clock(device, reference, **limits)
    assert str(caught.value)
    return caught.value.reason


@pytest.mark.parametrize("seconds", [3, 10, 60])
@pytest.mark.parametrize("missing", [0.0, 0.05, 0.2])
def test_a_regular_train_is_refused(seconds: int, missing: float) -> None:
    rng = np.random.default_rng(seconds)
    reference = np.arange(seconds * 100, dtype=np.int64) * TICK_NS
    seen = reference[rng.random(reference.size) >= missing]
    seen = seen + np.round(rng.normal(0, 5_000, seen.size)).astype(np.int64)
    assert refused(seen + 10**15, reference) == "ambiguous"


def test_another_trials_pulses_are_refused() -> None:
    whole = code(65_535, 1)
    for first in range(0, 60_000, 6_000):
        one, other = whole[first : first + 500], whole[first + 3_000 : first + 3_500]
        device = np.flatnonzero(one).astype(np.int64) * TICK_NS + 10**15
        reference = np.flatnonzero(other).astype(np.int64) * TICK_NS
        assert refused(device, reference) in {"ambiguous", "no_match"}


def test_too_few_pulses() -> None:
    made = trains(np.random.default_rng(12), 3)
    assert refused(made.device[:23], made.reference) == "too_few_pulses"
    assert refused(made.device, made.reference[:5]) == "too_few_pulses"
    assert refused(np.empty(0, np.int64), made.reference) == "too_few_pulses"
    # enough in all, but never enough together
    assert refused(np.arange(100, dtype=np.int64) * 10**9, made.reference) == "too_few_pulses"


def test_residuals_that_are_not_jitter() -> None:
    made = trains(np.random.default_rng(13), 10, jitter_ns=100_000)
    assert refused(made.device, made.reference) == "residuals"
    assert fit_clock(made.device, made.reference, jitter_ns=100_000).pulses_seen > 400


@pytest.mark.parametrize("ppm", [3.0, 20.0, -20.0, 60.0])
def test_a_clock_that_warms_up_gets_a_bent_line(ppm: float) -> None:
    """A drift that changes by so much over 60 s: a straight line would be off by 25 us a ppm."""
    rng = np.random.default_rng(13)
    made = trains(rng, 60)
    bend = 0.5e-6 * ppm * (made.reference - made.reference[0]) ** 2.0 / 60e9
    shift = np.rint(bend).astype(np.int64)
    at = np.searchsorted(made.true_device, made.device, side="right") - 1
    made.device = made.device + shift[np.clip(at, 0, None)]
    made.true_device = made.true_device + shift
    fit = fit_clock(made.device, made.reference, max_drift_ppm=200)
    assert len(fit.map.drift) > 1
    assert worst_error(fit, made) < min(1.5 * fit.uncertainty_ns, 10_000)
    slopes = np.array(fit.map.drift) / 1e12
    knots = np.append(fit.map.device_ns, made.true_device[-1])
    middles = (knots[1:] + knots[:-1]) / 2
    apart = (middles[-1] - middles[0]) / 60e9
    assert slopes[-1] - slopes[0] == pytest.approx(-ppm * apart, abs=3)


def test_a_clock_that_bends_like_no_crystal_is_refused() -> None:
    made = trains(np.random.default_rng(13), 60)
    along = (made.device - made.device[0]) / 60e9
    bent = made.device + (along**2 * 2e7).astype(np.int64)
    assert refused(bent, made.reference, max_drift_ppm=400) == "drift"
    shaken = made.device + (2e6 * np.sin(2 * np.pi * 60 * along)).astype(np.int64)
    assert refused(shaken, made.reference) == "residuals"


def test_a_clock_that_jumps_in_the_middle_is_refused() -> None:
    made = trains(np.random.default_rng(14), 20)
    made.device[made.device.size // 2 :] += 3_000_000
    assert refused(made.device, made.reference) in {"no_match", "residuals"}


def test_more_drift_than_allowed() -> None:
    made = trains(np.random.default_rng(15), 10, 300.0)
    assert refused(made.device, made.reference, max_drift_ppm=200) == "drift"
    fit_clock(made.device, made.reference, max_drift_ppm=400)


def test_wrong_arguments() -> None:
    times = np.arange(100, dtype=np.int64) * TICK_NS
    with pytest.raises(TypeError, match="int64"):
        loose(fit_clock)(times.astype(np.float64), times)
    with pytest.raises(ValueError, match="1-D"):
        fit_clock(times.reshape(10, 10), times)
    with pytest.raises(ValueError, match="max_drift_ppm"):
        fit_clock(times, times, max_drift_ppm=0)
    with pytest.raises(ValueError, match="told apart"):
        fit_clock(times, times, jitter_ns=5e6)
