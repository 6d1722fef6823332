"""Clocks that jump or drift: the fit is right within what it says, or refused; never wrong."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.clocks.clocks import ClockFit, ClockRefused, fit_clock
from sliplab.analysis.clocks.synchronise import split_at_restarts
from tests.analysis.clocks.test_clocks import TICK_NS, code

Ints = NDArray[np.int64]
JITTER_NS = 2_000.0


def trains(
    rng: np.random.Generator, seconds: float, jump_ns: float, ppm: float, share: float
) -> tuple[Ints, Ints, Ints]:
    """Stamps in whole us in the order of the pulses, their true device times, and the reference.

    Args:
        jump_ns, ppm: what the device's clock does once `share` of the train is over.
    """
    bits = code(int(seconds * 1e9 / TICK_NS), int(rng.integers(1, 1 << 16)))
    reference = np.flatnonzero(bits).astype(np.int64) * TICK_NS
    after = reference - share * seconds * 1e9
    true = reference * (1 + rng.uniform(-50e-6, 50e-6))
    true += np.where(after >= 0, jump_ns + after * ppm * 1e-6, 0.0)
    stamps = np.rint(true + rng.normal(0, JITTER_NS, true.size)).astype(np.int64) // 1000 * 1000
    return stamps, np.rint(true).astype(np.int64), reference


def fitted(stamps: Ints, reference: Ints) -> ClockFit | None:
    """The fit as the quality gates ask for it, None where it is refused."""
    try:
        return fit_clock(stamps, reference, in_order=True)
    except ClockRefused:
        return None


@pytest.mark.quick(5)
@pytest.mark.parametrize("seconds", [3.0, 6.0, 17.0])
@pytest.mark.parametrize("share", [0.05, 0.1, 0.35, 0.5, 0.75, 0.9, 0.95])
def test_a_jump_is_refused_or_inside_the_uncertainty(seconds: float, share: float) -> None:
    rng = np.random.default_rng([int(seconds), int(100 * share)])
    refused = 0
    sizes = [2e-6, 1e-5, 3e-5, 1e-4, 1e-3, 2.4e-3, 5e-3, 0.0137, 0.333, 4.567, 1000.0]
    for jump_s in [sign * size for size in sizes for sign in (1, -1)]:
        stamps, true, reference = trains(rng, seconds, jump_s * 1e9, 0.0, share)
        fit = fitted(stamps, reference)
        refused += fit is None
        if fit is not None:
            error = np.abs(fit.map.to_reference(true) - reference).max()
            # three sigma of the stamps: what one jump cannot be told from jitter by
            assert error <= fit.uncertainty_ns + 3 * JITTER_NS
            assert abs(jump_s) <= 1e-4
    assert refused >= 14


@pytest.mark.parametrize("seconds", [3.0, 6.0, 17.0])
@pytest.mark.parametrize("share", [0.1, 0.35, 0.5, 0.75, 0.9])
def test_a_drift_is_refused_or_inside_the_uncertainty(seconds: float, share: float) -> None:
    rng = np.random.default_rng([int(seconds), int(100 * share), 1])
    accepted, refused = 0, 0
    sizes = [1.0, 5.0, 20.0, 50.0, 200.0, 1000.0, 9000.0]
    for ppm in [sign * size for size in sizes for sign in (1, -1)]:
        stamps, true, reference = trains(rng, seconds, 0.0, ppm, share)
        fit = fitted(stamps, reference)
        accepted, refused = accepted + (fit is not None), refused + (fit is None)
        if fit is not None:
            error = np.abs(fit.map.to_reference(true) - reference).max()
            assert error <= fit.uncertainty_ns + 3 * JITTER_NS
    assert accepted >= 2
    assert refused >= 2


@pytest.mark.parametrize("ticks", [1, 2, -2, 10, 100])
def test_a_jump_by_whole_ticks_is_no_match(ticks: int) -> None:
    """Half of the pulses then meet others exactly; the fit must not be content with those."""
    rng = np.random.default_rng(ticks % 7)
    for share in (0.2, 0.5, 0.8):
        stamps, _, reference = trains(rng, 10.0, ticks * TICK_NS, 0.0, share)
        assert fitted(stamps, reference) is None


def test_a_jump_at_the_reference_is_refused_too() -> None:
    stamps, _, reference = trains(np.random.default_rng(1), 6.0, 0.0, 0.0, 0.0)
    for jump_ns in (1_300_000, -250_000_000):
        jumped = reference + np.where(np.arange(reference.size) > 100, jump_ns, 0)
        assert fitted(stamps, jumped) is None


def test_pulses_lost_doubled_and_late_here_and_there_are_no_jump() -> None:
    rng = np.random.default_rng(3)
    stamps, true, reference = trains(rng, 10.0, 0.0, 0.0, 0.0)
    for at in (30, 250, reference.size - 40):
        stamps[at : at + 5] += 1_500_000
    stamps = np.delete(stamps, np.arange(100, 140))
    stamps = np.sort(np.append(stamps, stamps[300:320] + 200_000))
    fit = fitted(stamps, reference)
    assert np.abs(fit.map.to_reference(true) - reference).max() <= 3 * fit.uncertainty_ns
    assert (fit.pulses_late, fit.pulses_missed) == (15, 40)


def test_times_that_fall_back_begin_a_new_stretch() -> None:
    times = np.array([5, 6, 7, 6, 8, 1, 2, 3], np.int64) * 1000
    assert split_at_restarts(times, 3_000) == [slice(0, 5), slice(5, 8)]
    assert split_at_restarts(times[:0], 10) == []
