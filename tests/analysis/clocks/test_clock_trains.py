"""The hard trains, each with its outcome: what a fit makes of them, and when it must say no."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from sliplab.analysis.clocks.clocks import ClockFit, ClockRefused, fit_clock, fit_numbered
from tests.analysis.clocks.test_clocks import DAY_NS, TICK_NS, code, trains, worst_error

Ints = NDArray[np.int64]


def fitted(device: Ints, reference: Ints, **limits: float) -> ClockFit | str:
    """The fit as a crystal's is asked for, or the reason why there is none."""
    try:
        return fit_clock(device, reference, in_order=True, **{"max_drift_ppm": 400.0, **limits})
    except ClockRefused as refusal:
        return refusal.reason


def issued(rng: np.random.Generator) -> tuple[Ints, Ints, Ints]:
    """A train as bad as a trial may have: stamps, reference, true device times."""
    made = trains(
        rng,
        rng.uniform(20, 60),
        rng.uniform(-200, 200),
        int(rng.integers(-DAY_NS, DAY_NS)),
        5_000,
        rng.uniform(0, 0.2),
        0.05,
        0.05,
        0.05,
    )
    return made.device, made.reference, made.true_device


@pytest.mark.long
def test_bad_trains_are_fitted_and_their_uncertainty_is_honest() -> None:
    rng = np.random.default_rng(2026)
    worst, held, count = 0.0, 0, 300
    for _ in range(count):
        device, reference, true = issued(rng)
        fit = fitted(device, reference)
        assert isinstance(fit, ClockFit), fit
        error = float(np.abs(fit.map.to_reference(true) - reference).max())
        worst, held = max(worst, error), held + (error <= fit.uncertainty_ns)
    assert worst < 10_000
    assert 0.92 <= held / count <= 0.98  # 95 %, and 2.4 standard deviations of chance


@pytest.mark.parametrize("count", [0, 1, 2, 23])
def test_hardly_any_pulses(count: int) -> None:
    made = trains(np.random.default_rng(count), 20)
    assert fitted(made.device[:count], made.reference) == "too_few_pulses"
    assert fitted(made.device, made.reference[:count]) == "too_few_pulses"


def test_all_pulses_late() -> None:
    """Each by another time: refused. All by the same: nothing shows it, and the fit is that late.

    That is why a delay that all pulses share stands apart in docs/clocks.md.
    """
    rng = np.random.default_rng(1)
    made = trains(rng, 20, missing=0, double=0, late=0, spurious=0)
    late = made.device + rng.integers(0, 2_000_000, made.device.size)
    assert fitted(late, made.reference) == "residuals"
    fit = fitted(made.device + 300_000, made.reference)
    assert isinstance(fit, ClockFit)
    assert worst_error(fit, made) == pytest.approx(300_000, abs=3_000)


def test_a_regular_train_needs_a_start_marker() -> None:
    rng = np.random.default_rng(2)
    beats = np.concatenate([[0], 16 + 2 * np.arange(900)]).astype(np.int64)
    reference = beats * TICK_NS
    true = np.round(reference / (1 + 80e-6)).astype(np.int64) + 10**15
    seen = true + np.round(rng.normal(0, 5_000, true.size)).astype(np.int64)
    assert fitted(seen, reference) == "ambiguous"
    marked = {"start_marker_ns": 16.0 * TICK_NS}
    kept = seen[rng.random(seen.size) > 0.1]
    kept = np.concatenate([seen[:1], kept[kept > seen[0]]])
    fit = fitted(kept, reference, **marked)
    assert isinstance(fit, ClockFit)
    assert np.abs(fit.map.to_reference(true) - reference).max() < 3_000
    # the marker not seen, or a second one: nobody knows where the train begins
    assert fitted(kept[1:], reference, **marked) == "ambiguous"
    later = np.concatenate([seen[:300], seen[307:308], seen[315:]])
    assert fitted(later, reference, **marked) in {"ambiguous", "no_match"}
    # and a train that began before the box says it did
    assert fitted(kept, reference[200:], **marked) == "ambiguous"


@pytest.mark.parametrize("jump_ns", [1_000_000, 5_000_000, 10_000_000, 4_000_000_000, -30_000_000])
def test_a_jump_in_the_middle(jump_ns: int) -> None:
    made = trains(np.random.default_rng(3), 20, missing=0.1, double=0.05, late=0.05, spurious=0.05)
    half = made.device.size // 2
    made.device[half:] += jump_ns
    assert fitted(made.device, made.reference) in {"residuals", "no_match"}


def test_two_trials_in_a_row() -> None:
    """Of two trials' pulses those of the box's trial count; a box that began anew is refused."""
    rng = np.random.default_rng(5)
    first, second = trains(rng, 20, 50.0, 10**14), trains(rng, 25, 50.0, 10**14 + 60 * 10**9)
    both = np.concatenate([first.device, second.device])
    for made in (first, second):
        fit = fitted(both, made.reference)
        assert isinstance(fit, ClockFit)
        assert worst_error(fit, made) < 3_000
    anew = np.concatenate([first.reference + 10**13, second.reference - second.reference[0]])
    assert fitted(both, anew) == "residuals"


def test_swapped_channels() -> None:
    """The camera's trigger line on the input of the code line, and device and box exchanged."""
    made = trains(np.random.default_rng(6), 20, 120.0)
    every_tick = np.arange(2_000, dtype=np.int64) * TICK_NS + 77
    assert fitted(every_tick, made.reference) in {"ambiguous", "no_match"}
    forth, back = fitted(made.device, made.reference), fitted(made.reference, made.device)
    assert isinstance(forth, ClockFit)
    assert isinstance(back, ClockFit)
    there = back.map.to_reference(forth.map.to_reference(made.true_device))
    # whole microseconds are cut on one side only
    assert np.abs(there - made.true_device).max() < 1_500


def test_pulses_on_one_clock_only() -> None:
    made = trains(np.random.default_rng(7), 20)
    nothing = np.empty(0, np.int64)
    assert fitted(made.device, nothing) == "too_few_pulses"
    assert fitted(nothing, made.reference) == "too_few_pulses"
    noise = np.sort(np.random.default_rng(8).integers(0, 20 * 10**9, 900))
    assert fitted(noise, made.reference) in {"ambiguous", "no_match", "residuals"}


def test_identical_clocks() -> None:
    reference = np.flatnonzero(code(2_000, 77)).astype(np.int64) * TICK_NS
    fit = fitted(reference, reference, resolution_ns=0.0)
    assert isinstance(fit, ClockFit)
    assert (fit.map.to_reference(reference) == reference).all()
    assert fit.uncertainty_ns < 10
    assert (fit.pulses_missed, fit.pulses_spurious, fit.pulses_late) == (0, 0, 0)


@pytest.mark.parametrize("ppm", [10_000.0, -10_000.0])
def test_a_drift_of_one_percent(ppm: float) -> None:
    made = trains(np.random.default_rng(9), 60, ppm, DAY_NS)
    assert fitted(made.device, made.reference) in {"drift", "no_match", "ambiguous"}
    fit = fitted(made.device, made.reference, max_drift_ppm=11_000)
    assert isinstance(fit, ClockFit)
    assert worst_error(fit, made) < 3_000


@pytest.mark.long
def test_a_trial_of_an_hour() -> None:
    """Five rounds of a 16-bit code: right where both saw all of it, refused where the first went.

    With irregular intervals, which do not come again, a part is enough.
    """
    made = trains(np.random.default_rng(10), 3_600, 35.0, 10**16)
    fit = fitted(made.device, made.reference)
    assert isinstance(fit, ClockFit)
    assert worst_error(fit, made) < 3_000
    late = made.device[made.device - 10**16 > 1_400 * 10**9]
    assert fitted(late, made.reference) == "ambiguous"
    rng = np.random.default_rng(11)
    ticks = np.cumsum(rng.integers(2, 10, 65_000)).astype(np.int64)
    reference = ticks * TICK_NS
    true = np.round(reference * (1 + 35e-6)).astype(np.int64) + 10**16
    seen = true + np.round(rng.normal(0, 5_000, true.size)).astype(np.int64)
    fit = fitted(seen[40_000:], reference)
    assert isinstance(fit, ClockFit)
    assert np.abs(fit.map.to_reference(true[40_000:]) - reference[40_000:]).max() < 3_000


def test_exposures_are_counted_on_both_sides() -> None:
    rng = np.random.default_rng(12)
    number = np.arange(2_000)
    edges = number * TICK_NS + np.round(rng.normal(0, 1_000, number.size)).astype(np.int64)
    true = np.round(number * TICK_NS * (1 - 90e-6)).astype(np.int64) + 10**15
    seen = true + np.round(rng.normal(0, 1_000, number.size)).astype(np.int64)
    kept = rng.random(number.size) > 0.05
    kept[[0, -1]] = True
    fit = fit_numbered(seen[kept], number[kept], edges, resolution_ns=0)
    error = fit.map.to_reference(true) - number * TICK_NS
    assert np.abs(error).max() <= fit.uncertainty_ns < 1_000
    assert (fit.pulses_seen, fit.pulses_late) == (kept.sum(), 0)
    # an edge reported twice is one; one that is missing inside is known by its place
    again = np.sort(np.append(np.delete(edges, 700), edges[900] + 40_000))
    assert fit_numbered(seen[kept], number[kept], again).pulses_seen >= kept.sum() - 2
    for lost in (edges[1:], edges[:-1], np.append(edges, edges[-1] + TICK_NS)):
        with pytest.raises(ClockRefused, match=r"counted \d+ exposures and the box stamped"):
            fit_numbered(seen[kept], number[kept], lost)
    with pytest.raises(ClockRefused, match=r"stamps of the device fall back by .* s"):
        fit_numbered(seen[::-1], number, edges)
