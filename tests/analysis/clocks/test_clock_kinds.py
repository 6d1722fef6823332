"""Each kind of fault: nothing wrong is accepted, good trains are, and the uncertainty holds."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.clock_kinds import HOPELESS, KINDS, faulty_train, tally
from benchmarks.clocks import DRIFT_PPM, make_train
from sliplab.analysis.clocks.clocks import ClockRefused, fit_clock
from tests.analysis.clocks.test_clock_faults import fitted
from tests.analysis.clocks.test_clocks import TICK_NS, code

JUMPS = tuple(kind for kind in KINDS if "jump" in kind)
GOOD = tuple(kind for kind in KINDS if kind not in (*HOPELESS, *JUMPS))
REFUSED = dict.fromkeys(("lost_30_on_both",), 0.1)


@pytest.mark.quick(3)
@pytest.mark.parametrize("kind", [*JUMPS, *HOPELESS])
def test_nothing_wrong_is_accepted(kind: str) -> None:
    found = tally(kind, 40)
    assert found.wrong == 0
    if "at_end" not in kind:
        assert found.refused > 0.9


@pytest.mark.quick(2)
@pytest.mark.parametrize("kind", GOOD)
def test_good_trains_are_accepted_and_their_uncertainty_holds(kind: str) -> None:
    found = tally(kind, 60)
    assert found.wrong == 0
    assert found.refused <= REFUSED.get(kind, 0.04)
    # of 60 trains 51 or more, but in one of 2,500 draws, where 95 % hold
    assert found.coverage[0] >= 0.85


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_the_table(kind: str) -> None:
    found = tally(kind, 1000)
    assert found.wrong <= (3 if kind == "jump_20us_at_end" else 0)
    if kind in GOOD:
        assert found.refused <= REFUSED.get(kind, 0.005)
        _, low, high = found.coverage
        assert low <= 0.97
        assert high >= 0.93


@pytest.mark.parametrize("seed", [2412, 2494])
def test_a_jump_taken_for_a_bend_is_within_the_stated_uncertainty(seed: int) -> None:
    """A jump of 20 us that a change of drift explains nearly as well is accepted, and stated."""
    made = faulty_train(np.random.default_rng([11, seed]), "jump_20us")
    fit = fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)
    vouched = (made.true >= fit.first_ns) & (made.true <= fit.last_ns)
    error = np.abs(fit.map.to_reference(made.true) - made.sent)[vouched].max()
    assert 5_000 < error <= fit.uncertainty_ns


@pytest.mark.parametrize("seed", [2534, 8076, 12596, 18778])
def test_a_jump_that_a_bend_explains_better_by_chance_is_stated(seed: int) -> None:
    """A tenth of a short train is so few pulses that a change of drift may explain them better."""
    made = make_train(
        np.random.default_rng([11, seed]),
        seconds=20.0,
        tick=50_000_000,
        clock=lambda sent, _: np.where(sent > 0.1 * sent[-1], 2e4, 0.0),
    )
    fit = fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)
    vouched = (made.true >= fit.first_ns) & (made.true <= fit.last_ns)
    error = np.abs(fit.map.to_reference(made.true) - made.sent)[vouched].max()
    assert 12_000 < error <= fit.uncertainty_ns


@pytest.mark.parametrize("seed", [2879, 5259, 7373])
def test_old_codes_that_begin_a_few_ticks_apart_are_two_trials(seed: int) -> None:
    made = faulty_train(np.random.default_rng([11, seed]), "other_trial_16_bits")
    with pytest.raises(ClockRefused, match=r"has \d+ pulses on ticks before .* share a stretch"):
        fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)


@pytest.mark.parametrize("seed", [19034, 32575])
def test_a_jump_by_ticks_behind_which_many_pulses_match_by_chance_is_refused(seed: int) -> None:
    made = faulty_train(np.random.default_rng([11, seed]), "lost_30_and_jump_of_ticks")
    with pytest.raises(ClockRefused, match=r"more would \d+ ticks away, .* by whole ticks"):
        fit_clock(made.device, made.reference, max_drift_ppm=DRIFT_PPM)


def test_a_stretch_that_two_trials_share_is_not_enough() -> None:
    """Recordings made with a code of 16 bits: trials were stretches of the same 65,535 ticks."""
    whole = np.flatnonzero(code(8_000, 77)).astype(np.int64) * TICK_NS
    trial = whole[whole < 2_000 * TICK_NS]
    for ticks in (2, 4, 9, 40, 400, 1_000, -4, -5, -9, -40, -400, -1_000):
        begin = (3_000 + ticks) * TICK_NS
        device = whole[(whole >= begin) & (whole < begin + 2_000 * TICK_NS)] + 10**15
        reference = whole[(whole >= 3_000 * TICK_NS) & (whole < 5_000 * TICK_NS)]
        with pytest.raises(ClockRefused) as caught:
            fit_clock(device, reference)
        assert caught.value.reason in {"no_match", "ambiguous"}
    # the device saw the trial before as well, or the end of this one alone: that is no doubt
    assert fitted(whole[whole < 5_000 * TICK_NS], trial) is not None
    assert fitted(trial[200:], trial) is not None
    # nor is noise before the first pulse and a device that was stopped early
    noise = np.sort(-np.random.default_rng(6).integers(0, 300 * TICK_NS, 8))
    assert fitted(np.concatenate((noise, trial[:-40])), trial) is not None


@pytest.mark.parametrize("pulses", [1, 2])
def test_a_jump_at_the_last_pulses_is_not_vouched_for(pulses: int) -> None:
    for seed in range(20):
        made = faulty_train(np.random.default_rng(seed), "good")
        at = int(made.true[-pulses])
        device = np.where(made.device > at - made.tick_ns // 4, made.device + 10**6, made.device)
        try:
            fit = fit_clock(device, made.reference, max_drift_ppm=400)
        except ClockRefused:
            continue
        assert fit.last_ns < at
        vouched = (made.true >= fit.first_ns) & (made.true <= fit.last_ns)
        error = np.abs(fit.map.to_reference(made.true) - made.sent)[vouched].max()
        assert error <= 3 * fit.uncertainty_ns


def test_clocks_that_jump_are_told_from_clocks_that_bend() -> None:
    rng = np.random.default_rng(1)
    reference = np.flatnonzero(code(4_000, 77)).astype(np.int64) * TICK_NS
    for place in (0.2, 0.5, 0.8):
        after = np.maximum(reference - place * reference[-1], 0.0)
        noise = rng.normal(0, 5_000, reference.size)
        bent = np.rint(reference + noise + 2e-6 * after).astype(np.int64)
        jumped = np.rint(reference + noise + 15_000 * (after > 0)).astype(np.int64)
        fit = fitted(bent, reference)
        knots = np.array(fit.map.device_ns)
        assert np.abs(knots - place * reference[-1]).min() < 2e9
        with pytest.raises(ClockRefused, match=r"jumped by 1[345]\.\d us"):
            fit_clock(jumped, reference)
