"""What losses explain of the pulses that a fit leaves out, and what they do not."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from sliplab.analysis.clocks import pulse_losses
from sliplab.analysis.clocks.pulse_losses import TickTrains, on_ticks, staggered_ends, stray_stretch
from sliplab.rigs.core.pulse_code import code_bits

Ints = NDArray[np.int64]


def test_stretches_are_told_from_scattered_pulses() -> None:
    times = np.arange(200) * 1e7
    every = np.arange(200)
    assert stray_stretch(times, times, every, every, 1.0) is None
    for bad, said in (
        (np.arange(50, 60), "10 pulses in a row lie off the line, by more than 0.0 us (at most 9"),
        (np.arange(197, 200), "the last 3 pulses lie off the line"),
        (np.arange(0, 3), "the first 3 pulses lie off the line"),
        (np.arange(60, 100, 2), "of 24 pulses in a row 12 lie off"),
        (np.array([186, 188, 191, 194, 197]), "of 16 pulses at one end 5 lie off"),
    ):
        left = np.setdiff1d(every, bad)
        found = stray_stretch(times, times, left, left, 1.0)
        assert found.startswith(said)
    for harmless in (np.arange(50, 59), np.arange(198, 200), np.arange(0, 200, 9)[1:-1]):
        left = np.setdiff1d(every, harmless)
        assert stray_stretch(times, times, left, left, 1.0) is None
    # a device that lost a stretch says nothing there, and is not doubted
    left = np.setdiff1d(every, np.arange(50, 120))
    assert stray_stretch(times[left], times, np.arange(left.size), left, 1.0) is None


def test_pulses_are_numbered_by_their_ticks() -> None:
    rng = np.random.default_rng(1)
    ticks = np.flatnonzero(code_bits(5, 3_000))
    # a tick that is known to a part in a thousand only
    reference = (ticks - ticks[0]) * 1e7
    device = ticks[40:-40] + rng.normal(0, 0.5e-3, ticks.size - 80)
    late, noise = device[::10] + 0.01, rng.uniform(ticks[40], ticks[-40], 50)
    some = np.sort(np.concatenate((device, late, noise, [-40.0, -39.9]))) - ticks[0]
    found = on_ticks(some * 1e7, reference, 1.001e7, 2.5e4)
    assert np.array_equal(found.reference, ticks - ticks[0])
    assert set(ticks[60:-60] - ticks[0]) <= set(found.device)
    # 50 pulses of noise lie anywhere, on a tick (0.5 %) hardly ever
    assert np.setdiff1d(found.device, found.reference).size <= 3
    assert found.device[0] == -40 - ticks[0]
    assert -39 - ticks[0] not in found.device


def lossy(
    rng: np.random.Generator, ticks: Ints, device_loss: float, reference_loss: float
) -> tuple[Ints, Ints]:
    """The ticks that two recorders of the same pulses report."""
    device, reference = (
        ticks[rng.random(ticks.size) >= loss] for loss in (device_loss, reference_loss)
    )
    return device, reference


@pytest.mark.parametrize("losses", [(0.02, 0.0), (0.2, 0.05), (0.35, 0.3), (0.5, 0.5)])
def test_ends_of_one_trials_trains_look_as_likely_as_they_are(losses: tuple[float, float]) -> None:
    """Of a probability of 1 % or less one says so in about 1 % of the trials, not more."""
    rng = np.random.default_rng(2)
    unlikely, count = 0, 2_000
    for seed in range(1, count + 1):
        ticks = np.flatnonzero(code_bits(seed, 600)).astype(np.int64)
        unlikely += staggered_ends(TickTrains(*lossy(rng, ticks, *losses))).chance < 0.01
    # the product of two probabilities is small more often than either is: p (1 - ln p), either way
    assert unlikely / count < 2 * 0.01 * (1 - np.log(0.01))


@pytest.mark.parametrize("ticks_apart", [6, 12, 24, -6, -12, -24])
def test_trains_that_begin_apart_are_not_one_trials(ticks_apart: int) -> None:
    rng = np.random.default_rng(3)
    reported, count = 0, 100
    for seed in range(1, count + 1):
        ticks = np.flatnonzero(code_bits(seed, 1_100)).astype(np.int64)
        one = ticks[(ticks >= 50) & (ticks < 1_050)]
        other = ticks[(ticks >= 50 + ticks_apart) & (ticks < 1_050 + ticks_apart)]
        device, reference = lossy(rng, one, 0.1, 0.0)[0], other
        found = staggered_ends(TickTrains(device - other[0], reference - other[0]))
        reported += found.chance < 1e-3
        if found.chance < 1e-3:
            assert found.earlier == ("device" if ticks_apart > 0 else "reference")
            assert 1 <= min(found.first, found.last) <= pulse_losses.END_TICKS
    assert reported >= 0.9 * count


def test_a_train_that_lies_within_the_other_is_no_other_trials() -> None:
    ticks = np.flatnonzero(code_bits(9, 2_000)).astype(np.int64)
    for part in (ticks[20:-20], ticks[20:], ticks[:-20]):
        assert staggered_ends(TickTrains(part, ticks)).chance == 1.0
        assert staggered_ends(TickTrains(ticks, part)).chance == 1.0


@given(st.integers(1, 2**32 - 2), st.integers(-19, 19), st.floats(0.25, 0.75))
def test_a_jump_by_whole_ticks_is_found(seed: int, jump: int, place: float) -> None:
    """With 30 % missing on both sides, and 250 pulses on the shorter side of the jump."""
    ticks = np.flatnonzero(code_bits(seed, 2_000)).astype(np.int64)
    device, reference = lossy(np.random.default_rng(seed), ticks, 0.3, 0.3)
    jumped = np.where(device > 2_000 * place, device + jump, device)
    found, chance = pulse_losses.better_shift(TickTrains(np.unique(jumped), reference))
    if jump == 0:
        assert chance > 1e-5
    else:
        assert found == -jump
        assert chance < 1e-6


def test_chance_alone_hardly_ever_looks_like_a_jump() -> None:
    rng = np.random.default_rng(4)
    chances = []
    for seed in range(1, 1_001):
        ticks = np.flatnonzero(code_bits(seed, 600)).astype(np.int64)
        chances.append(pulse_losses.better_shift(TickTrains(*lossy(rng, ticks, 0.3, 0.3)))[1])
    small = np.array(chances)
    # the bound holds: no more than 1 % say 1 % or less, and 2.5 standard deviations of chance
    assert (small <= 0.01).sum() <= 10 + 2.5 * 10**0.5
    assert (small <= 1e-4).sum() <= 1


def test_a_stretch_that_one_side_lost_is_no_jump() -> None:
    ticks = np.flatnonzero(code_bits(11, 1_500)).astype(np.int64)
    device, reference = lossy(np.random.default_rng(5), ticks, 0.3, 0.3)
    for gap in ((600, 900), (1_200, 1_500)):
        kept = reference[(reference < gap[0]) | (reference >= gap[1])]
        assert pulse_losses.better_shift(TickTrains(device, kept))[1] > 1e-2
