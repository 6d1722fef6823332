"""The code must be maximal: that is all that makes an alignment unambiguous."""

import numpy as np
import pytest

from rigs.pulse_code import PERIOD, code_bits


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
    assert len(code_bits(1, 0)) == 0
    with pytest.raises(ValueError, match="negative"):
        code_bits(1, -1)
