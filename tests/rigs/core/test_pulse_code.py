"""The codes on the sync line: whatever makes an alignment unambiguous is held here."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.protocols.timing import MARKER_TICKS, Code
from sliplab.rigs.core.pulse_code import LONGEST_GAP_TICKS, SEEDS, code_bits

CODES: tuple[Code, ...] = ("lfsr", "irregular", "regular")
HOUR = 360_000
"""Ticks of an hour at 100 Hz."""


def intervals(bits: np.ndarray) -> np.ndarray:
    return np.diff(np.flatnonzero(bits))


def power_of_x(exponent: int) -> int:
    """x to that power modulo the register's polynomial, over GF(2)."""
    result, square = 1, 2
    while exponent:
        if exponent & 1:
            result = product(result, square)
        square, exponent = product(square, square), exponent >> 1
    return result


def product(one: int, other: int) -> int:
    found = 0
    while other:
        found ^= one if other & 1 else 0
        one, other = one << 1, other >> 1
        one ^= (1 << 32 | 1 << 22 | 0b111) if one >> 32 else 0
    return found


def test_the_code_comes_again_after_all_states_and_not_before() -> None:
    """The order of x is 2**32 - 1 and no divisor of it: the polynomial is primitive."""
    period = 2**32 - 1
    assert power_of_x(period) == 1
    assert period == 3 * 5 * 17 * 257 * 65_537
    assert all(power_of_x(period // prime) != 1 for prime in (3, 5, 17, 257, 65_537))


@pytest.mark.parametrize("n", [1, 31, 32, 33, 300, 5000])
def test_it_is_the_register_stepped_bit_by_bit(n: int) -> None:
    state, expected = 0xBEEF * 2654435761 % 2**32, []
    for _ in range(n):
        expected.append(state & 1)
        fed = (state ^ (state >> 1) ^ (state >> 2) ^ (state >> 22)) & 1
        state = (state >> 1) | (fed << 31)
    assert code_bits(0xBEEF, n).tolist() == expected


def test_half_of_the_ticks_have_a_pulse() -> None:
    assert code_bits(77, HOUR).mean() == pytest.approx(0.5, abs=0.003)


@pytest.mark.quick(1)
@pytest.mark.parametrize(("code", "bits", "length"), [("lfsr", 1, 60), ("irregular", 3, 20)])
def test_trials_share_no_stretch_of_the_code(code: Code, bits: int, length: int) -> None:
    """Of 500 trials of 20 s no two have the same 60 ticks, or 20 intervals, anywhere."""
    words = []
    for seed in np.random.default_rng(4).integers(1, SEEDS, 500).tolist():
        sent = code_bits(seed, 2000, code)
        part = sent.astype(np.int64) if code == "lfsr" else intervals(sent) - 2
        count = len(part) - length + 1
        words.append(sum(part[k : k + count] << bits * k for k in range(length)))
    every = np.concatenate(words)
    assert np.unique(every).size == every.size


@pytest.mark.parametrize("seed", [0, -1, 2**32 - 1])
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
def test_no_silence_is_longer_than_is_said_in_an_hour(code: Code) -> None:
    gaps = intervals(code_bits(1234, HOUR, code))
    assert gaps.min() >= 1
    assert gaps.max() <= LONGEST_GAP_TICKS


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
