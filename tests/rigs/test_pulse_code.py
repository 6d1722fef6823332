"""The codes on the sync line: whatever makes an alignment unambiguous is held here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocols.timing import MARKER_TICKS, Code
from rigs.pulse_code import PERIOD, SEEDS, code_bits

CODES: tuple[Code, ...] = ("lfsr", "irregular", "regular")
HOUR = 360_000
"""Ticks of an hour at 100 Hz."""


def intervals(bits: np.ndarray) -> np.ndarray:
    return np.diff(np.flatnonzero(bits))


def test_any_16_bits_in_a_row_are_unique_over_the_whole_period() -> None:
    bits = code_bits(0xACE1, PERIOD + 15).astype(np.int64)
    words = sum(bits[shift : shift + PERIOD] << shift for shift in range(16))
    assert len(np.unique(words)) == PERIOD
    assert words.min() == 1


def test_it_repeats_after_the_period_and_not_before() -> None:
    bits = code_bits(1, 2 * PERIOD)
    assert np.array_equal(bits[:PERIOD], bits[PERIOD:])
    for divisor in (3, 5, 17, 257):
        assert not np.array_equal(bits[:PERIOD], np.roll(bits[:PERIOD], PERIOD // divisor))


@pytest.mark.parametrize("n", [1, 15, 16, 17, 300, 5000])
def test_it_is_the_register_stepped_bit_by_bit(n: int) -> None:
    state, expected = 0xBEEF, []
    for _ in range(n):
        expected.append(state & 1)
        fed = (state ^ (state >> 2) ^ (state >> 3) ^ (state >> 5)) & 1
        state = (state >> 1) | (fed << 15)
    assert code_bits(0xBEEF, n).tolist() == expected


def test_balanced_but_for_the_missing_zero_state() -> None:
    assert code_bits(77, PERIOD).sum() == 32768


def test_seeds_are_shifts_of_one_code() -> None:
    bits = code_bits(1, PERIOD).astype(np.int64)
    seed = int(sum(bits[100 + shift] << shift for shift in range(16)))
    assert np.array_equal(code_bits(seed, 500), bits[100:600].astype(np.uint8))


@pytest.mark.parametrize("seed", [0, -1, 65536])
def test_a_state_that_is_none_is_refused(seed: int) -> None:
    with pytest.raises(ValueError, match="seed"):
        code_bits(seed, 4)


def test_no_bits() -> None:
    for code in CODES:
        assert len(code_bits(1, 0, code)) == 0
    with pytest.raises(ValueError, match="negative"):
        code_bits(1, -1)


@given(st.integers(1, SEEDS), st.integers(0, 5000), st.integers(0, 5000), st.sampled_from(CODES))
def test_a_code_is_its_seeds_however_much_is_asked_for(
    seed: int, n: int, more: int, code: Code
) -> None:
    bits = code_bits(seed, n, code)
    assert (bits.shape, bits.dtype) == ((n,), np.dtype(np.uint8))
    assert set(bits.tolist()) <= {0, 1}
    assert np.array_equal(bits, code_bits(seed, n + more, code)[:n])


@pytest.mark.parametrize("code", CODES)
def test_no_silence_is_longer_than_15_ticks_in_an_hour(code: Code) -> None:
    gaps = intervals(code_bits(1234, HOUR, code))
    assert gaps.min() >= 1
    assert gaps.max() <= 16


def test_irregular_is_what_the_boxs_firmware_draws() -> None:
    x, expected = 4321 * 2654435761 % 2**32, [0]
    for _ in range(200):
        x ^= (x << 13) % 2**32
        x ^= x >> 17
        x ^= (x << 5) % 2**32
        expected.append(expected[-1] + 2 + (x >> 29))
    bits = code_bits(4321, expected[-1] + 1, "irregular")
    assert np.flatnonzero(bits).tolist() == expected


@given(st.integers(1, SEEDS))
def test_irregular_intervals_are_all_of_2_to_9_alike_often(seed: int) -> None:
    gaps = intervals(code_bits(seed, 20_000, "irregular"))
    counts = np.bincount(gaps, minlength=10)
    assert counts[:2].sum() == 0
    assert len(counts) == 10
    assert counts[2:] == pytest.approx(len(gaps) / 8, rel=0.3)


def test_irregular_never_comes_again_in_an_hour() -> None:
    gaps = intervals(code_bits(77, HOUR, "irregular")).astype(np.int64)
    words = sum(gaps[k : len(gaps) - 19 + k] << 3 * k for k in range(20))
    assert len(np.unique(words)) == len(words)


def test_other_seeds_are_other_irregular_trains() -> None:
    starts = {tuple(intervals(code_bits(seed, 300, "irregular"))[:12]) for seed in range(1, 2000)}
    assert len(starts) == 1999


def test_regular_has_one_marker_at_its_start() -> None:
    gaps = intervals(code_bits(9, HOUR, "regular"))
    assert gaps[0] == MARKER_TICKS
    assert np.all(gaps[1:] == 2)
