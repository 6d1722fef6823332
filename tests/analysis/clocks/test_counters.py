"""Wrapped counters and restarts, against times that never wrapped."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.clocks.counters import split_at_restarts, unwrap

TICKS_NS = [1_000, 8]


@given(
    tick=st.sampled_from(TICKS_NS),
    first=st.integers(0, 2**32 - 1),
    seed=st.integers(0, 2**32 - 1),
    stamps=st.integers(1, 400),
)
def test_several_wraps_are_undone(tick: int, first: int, seed: int, stamps: int) -> None:
    turn = 2**32
    steps = np.random.default_rng(seed).integers(0, turn // 2, stamps)
    true = first + np.cumsum(steps)
    made = unwrap((true % turn).astype(np.uint32), 32, tick, turn // 2 * tick)
    assert (made.ns - made.ns[0] == (true - true[0]) * tick).all()
    assert made.ns[0] == int(true[0] % turn) * tick
    assert made.wraps == int(true[-1] // turn - true[0] // turn)
    assert made.starts.tolist() == [0]


@pytest.mark.parametrize("tick", TICKS_NS)
@pytest.mark.parametrize("turns", [0, 1, 3])
def test_a_wrap_in_the_middle_of_a_gap(tick: int, turns: int) -> None:
    """Nothing comes while the counter wraps; the host's clock says how often it did."""
    turn = 2**32
    true = np.concatenate([np.arange(100), np.arange(100) + turns * turn + turn // 3 + 10_000])
    true = true * 1000 + turn - 200_000
    host = true * tick + 5_000_000 + np.random.default_rng(1).integers(0, 10**6, true.size)
    made = unwrap((true % turn).astype(np.uint32), 32, tick, turn // 2 * tick, host_ns=host)
    assert (np.diff(made.ns) == np.diff(true) * tick).all()
    assert made.starts.tolist() == [0]


def test_a_restart_splits_the_stamps() -> None:
    counts = np.concatenate([np.arange(1_000_000, 2_000_000, 1000), np.arange(50, 500_050, 1000)])
    for host in (None, np.concatenate([counts[:1000], counts[1000:] + 60_000_000]) * 1000):
        made = unwrap(counts.astype(np.uint32), 32, 1_000, 10**9, host_ns=host)
        assert made.starts.tolist() == [0, 1000]
        first, second = made.stretches
        assert (made.ns[first] == counts[:1000] * 1000).all()
        assert (made.ns[second] == counts[1000:] * 1000).all()
        assert made.wraps == 0


def test_wrong_arguments() -> None:
    counts = np.arange(5, dtype=np.uint32)
    assert unwrap(counts[:0], 32, 1, 1000).stretches == []
    with pytest.raises(TypeError, match="integers"):
        unwrap(counts.astype(float), 32, 1, 1000)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="counts must lie"):
        unwrap(counts + 16, 4, 1, 10)
    with pytest.raises(ValueError, match="max_gap_ns"):
        unwrap(counts, 4, 1, 16)
    with pytest.raises(ValueError, match="host_error_ns"):
        unwrap(counts, 32, 1, 1000, host_ns=counts, host_error_ns=2**31)
    with pytest.raises(ValueError, match="turn"):
        unwrap(counts, 62, 8, 1000)


def test_times_that_fall_back_begin_a_new_stretch() -> None:
    times = np.array([5, 6, 7, 6, 8, 1, 2, 3], np.int64) * 1000
    assert split_at_restarts(times, 3_000) == [slice(0, 5), slice(5, 8)]
    assert split_at_restarts(times[:0], 10) == []
