"""Clocks from bounds: what is stated always holds, for it is no estimate."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.clocks.clock_bounds import BoundsContradictError, fit_bounds, fit_messages


@pytest.mark.long
@given(
    seed=st.integers(0, 2**32 - 1),
    ppm=st.floats(-190, 190),
    offset=st.integers(-(2**61), 2**61),
    pairs=st.integers(3, 300),
    longest_ms=st.floats(0.01, 50),
)
def test_the_truth_lies_inside_the_stated_bounds(
    seed: int, ppm: float, offset: int, pairs: int, longest_ms: float
) -> None:
    rng = np.random.default_rng(seed)
    device = np.sort(rng.integers(0, 30 * 10**9, pairs))
    true = device + np.rint(device * ppm * 1e-6).astype(np.int64)
    before = true - rng.integers(0, int(longest_ms * 1e6) + 1, pairs)
    after = true + rng.integers(0, int(longest_ms * 1e6) + 1, pairs)
    found = fit_bounds(device + offset, before, after, 200.0)
    error = np.abs(found.map.to_reference(device + offset) - true)
    assert error.max() <= found.uncertainty_ns + 2
    assert abs(found.drift_ppm - ppm) <= found.drift_error_ppm + 1e-3
    assert abs(found.drift_ppm) <= 200.0 + 1e-6
    assert found.uncertainty_ns <= longest_ms * 1e6 + 200e-6 * 30e9 + 2


def test_many_round_trips_leave_less_than_the_shortest_of_them() -> None:
    """Bounds of 0.1 to 2 ms each: together they leave less than a tenth."""
    rng = np.random.default_rng(1)
    device = np.arange(300, dtype=np.int64) * 10**8
    before = device - (1e5 * rng.exponential(4, 300)).astype(np.int64) - 50_000
    after = device + (1e5 * rng.exponential(4, 300)).astype(np.int64) + 50_000
    found = fit_bounds(device, before, after, 100.0)
    assert found.tightest_ns > 100_000
    assert found.uncertainty_ns < 0.9 * found.tightest_ns
    assert np.abs(found.map.to_reference(device) - device).max() <= found.uncertainty_ns


def test_messages_with_a_known_longest_delay() -> None:
    rng = np.random.default_rng(2)
    device = np.arange(15_000, dtype=np.int64) * 2_000_000
    arrival = device + 500_000 + (1e6 * rng.exponential(0.5, device.size)).astype(np.int64)
    found = fit_bounds(device, arrival - 20_000_000, arrival, 100.0)
    # not far below half of what is allowed: not the millisecond that it looks like
    assert 8_000_000 < found.uncertainty_ns < 10_000_000
    assert np.abs(found.map.to_reference(device) - device).max() <= found.uncertainty_ns


@pytest.mark.parametrize("jumps", [(), (0.5,), (0.2, 0.7), (0.04,)])
@pytest.mark.parametrize("delay", ["even", "rarely long", "nearly constant"])
@pytest.mark.parametrize("jump_ms", [-4.5, -3.0, 0.4, 4.5])
def test_a_jump_that_hides_among_delays_stays_within_the_bound(
    jump_ms: float, delay: str, jumps: tuple[float, ...]
) -> None:
    rng = np.random.default_rng([round(jump_ms * 10) % 1000, len(delay), len(jumps)])
    true = np.cumsum(rng.integers(7_000_000, 9_000_000, 4000))
    taken_ms = {
        "even": rng.uniform(0, 20, true.size),
        "rarely long": np.minimum(0.5 + rng.exponential(1.0, true.size), 20),
        "nearly constant": rng.uniform(4.0, 4.3, true.size),
    }[delay]
    arrival = true + np.rint(1e6 * taken_ms).astype(np.int64)
    clock = true + np.rint(30e-6 * true).astype(np.int64)
    for share in jumps:
        clock = np.where(np.arange(true.size) < share * true.size, clock, clock + jump_ms * 1e6)
    device = np.rint(clock).astype(np.int64)
    found = fit_messages(device, arrival - 30_000_000, arrival, 100.0)
    assert np.abs(found.map.to_reference(device) - true).max() <= found.uncertainty_ns
    assert found.uncertainty_ns < 31_000_000


def test_without_a_jump_the_bound_of_messages_is_little_wider() -> None:
    rng = np.random.default_rng(4)
    device = np.arange(15_000, dtype=np.int64) * 2_000_000
    arrival = device + rng.integers(500_000, 8_000_000, device.size)
    strict = fit_bounds(device, arrival - 20_000_000, arrival, 100.0)
    found = fit_messages(device, arrival - 20_000_000, arrival, 100.0)
    assert strict.uncertainty_ns < found.uncertainty_ns < 1.15 * strict.uncertainty_ns
    assert found.map.to_reference(device).tolist() == pytest.approx(
        strict.map.to_reference(device).tolist(), abs=100_000
    )


def test_contradictions_are_errors() -> None:
    device = np.arange(10, dtype=np.int64) * 10**9
    with pytest.raises(BoundsContradictError, match=r"10 of 10 instants .* by 0\.001 us at most"):
        fit_bounds(device, device + 1, device, 100.0)
    jumped = device + np.where(device > 5 * 10**9, 10**8, 0)
    with pytest.raises(BoundsContradictError, match="jumped"):
        fit_bounds(device, jumped - 1000, jumped + 1000, 100.0)
    fast = device + device // 1000
    with pytest.raises(BoundsContradictError, match="drifts by at most 100 ppm"):
        fit_bounds(device, fast - 1000, fast + 1000, 100.0)
    with pytest.raises(ValueError, match="at least 3"):
        fit_bounds(device[:2], device[:2], device[:2], 100.0)
    with pytest.raises(ValueError, match="equally long"):
        fit_bounds(device, device[:5], device, 100.0)
