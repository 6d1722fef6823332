"""The clock map against Python's big integers, at the sizes where floats and int64 give way."""

from __future__ import annotations

import json
from fractions import Fraction
from math import floor

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from storage.clockmap import IDENTITY, MAX_DRIFT_PPB, ClockMap

DRIFTS = st.integers(-MAX_DRIFT_PPB, MAX_DRIFT_PPB)
TIMES = st.integers(-(2**62), 2**62)
SPANS = st.integers(-(2**61), 2**61)


def exact(clock: ClockMap, device: int) -> Fraction:
    d = device - clock.device_anchor_ns
    return clock.reference_anchor_ns + d * (1 + Fraction(clock.drift_ppb, 10**9))


def half_up(value: Fraction) -> int:
    return floor(value + Fraction(1, 2))


@given(anchor=TIMES, image=SPANS, drift=DRIFTS, spans=st.lists(SPANS, min_size=1, max_size=20))
def test_every_time_is_the_exact_one_rounded(
    anchor: int, image: int, drift: int, spans: list[int]
) -> None:
    clock = ClockMap(anchor, image, drift)
    times = [max(-(2**63), min(2**63 - 1, anchor + span)) for span in spans]
    expected = [half_up(exact(clock, time)) for time in times]
    assert [clock.to_reference(time) for time in times] == expected
    assert clock.to_reference(np.array(times, np.int64)).tolist() == expected


@given(anchor=TIMES, image=SPANS, drift=DRIFTS, spans=st.lists(SPANS, min_size=1, max_size=20))
def test_there_and_back_is_within_a_nanosecond(
    anchor: int, image: int, drift: int, spans: list[int]
) -> None:
    clock = ClockMap(anchor, image, drift)
    times = np.array([max(-(2**63), min(2**63 - 1, anchor + span)) for span in spans], np.int64)
    back = clock.to_device(clock.to_reference(times))
    assert max(abs(int(a) - int(b)) for a, b in zip(back, times, strict=True)) <= 1
    assert back.tolist() == [clock.to_device(clock.to_reference(int(t))) for t in times]
    references = image + times // 4 - anchor // 4
    forth = clock.to_reference(clock.to_device(references))
    assert np.abs(forth - references).max() <= 1


@given(base=st.sampled_from([2**53, 2**62]), drift=DRIFTS, step=st.integers(2, 10_000))
def test_order_is_kept_where_floats_lose_it(base: int, drift: int, step: int) -> None:
    times = base + np.arange(0, 64 * step, step, dtype=np.int64)
    for clock in (ClockMap(base - 10**15, base - 7, drift), ClockMap(base, 0, drift)):
        mapped = clock.to_reference(times)
        assert (np.diff(mapped) > 0).all()
        # neighbours never swap either
        assert (np.diff(clock.to_reference(base + np.arange(1000))) >= 0).all()


def test_a_nanosecond_stays_distinct_without_drift() -> None:
    for base in (2**53, 2**62):
        mapped = ClockMap(base, 0, 0).to_reference(np.array([base, base + 1]))
        assert mapped.tolist() == [0, 1]


def test_known_values() -> None:
    clock = ClockMap(1_000, 5_000, 100_000)  # 100 ppm
    assert clock.to_reference(1_000) == 5_000
    assert clock.to_reference(1_000 + 10**9) == 5_000 + 10**9 + 100_000
    assert clock.to_reference(1_000 - 10**9) == 5_000 - 10**9 - 100_000
    # 5,000 ns * 100 ppm = 0.5 ns: halves go up, on both sides of the anchor
    assert clock.to_reference(1_000 + 5_000) == 10_001
    assert clock.to_reference(1_000 - 5_000) == 0
    assert IDENTITY.to_reference(42) == IDENTITY.to_device(42) == 42


@pytest.mark.parametrize("drift", [99_999_999, 50_000_001, -99_999_999, -33_333_333])
def test_a_hair_below_the_half_is_rounded_down(drift: int) -> None:
    # rest * drift = 499,999,999 modulo 1e9: a float division cannot tell that from the half
    rest = 499_999_999 * pow(drift, -1, 10**9) % 10**9
    times = 2**53 + np.arange(5, dtype=np.int64) * 10**9 + rest
    clock = ClockMap(2**53, 0, drift)
    assert clock.to_reference(times).tolist() == [half_up(exact(clock, int(t))) for t in times]


def test_shapes_and_kinds() -> None:
    clock = ClockMap(0, 10, 0)
    assert clock.to_reference(np.zeros((2, 3), np.int64)).shape == (2, 3)
    assert clock.to_reference(np.empty(0, np.int64)).dtype == np.int64
    assert clock.to_reference(np.array([1], np.uint32)).dtype == np.int64
    assert type(clock.to_reference(np.int64(1))) is int
    source = np.arange(5)
    clock.to_reference(source)
    assert source.tolist() == [0, 1, 2, 3, 4]


@given(
    anchor=TIMES, middle=TIMES, gap=st.integers(-(10**15), 10**15), last=SPANS,
    drifts=st.tuples(st.integers(-(10**6), 10**6), st.integers(-(10**6), 10**6)),
    span=st.integers(-(10**11), 10**11),
)  # fmt: skip
def test_two_maps_in_a_row_are_one(
    anchor: int, middle: int, gap: int, last: int, drifts: tuple[int, int], span: int
) -> None:
    first, second = ClockMap(anchor, middle, drifts[0]), ClockMap(middle + gap, last, drifts[1])
    two_steps = second.to_reference(first.to_reference(anchor + span))
    allowed = 2 + abs(span) / 1e9
    assert abs(first.then(second).to_reference(anchor + span) - two_steps) <= allowed


def test_json_keeps_every_bit() -> None:
    clock = ClockMap(2**62 + 1, -(2**53) - 1, -99_999)
    assert ClockMap.from_json(json.loads(json.dumps(clock.to_json()))) == clock


@pytest.mark.parametrize(
    "data",
    [
        {"device_anchor_ns": 0, "reference_anchor_ns": 0},
        {"device_anchor_ns": 0, "reference_anchor_ns": 0, "drift_ppb": 0, "drift_ppm": 0},
        {"device_anchor_ns": 0, "reference_anchor_ns": 0, "drift_ppb": MAX_DRIFT_PPB + 1},
        {"device_anchor_ns": 2**63, "reference_anchor_ns": 0, "drift_ppb": 0},
    ],
)
def test_bad_fields_are_refused(data: dict[str, int]) -> None:
    with pytest.raises(ValueError, match=r"fields|ClockMap"):
        ClockMap.from_json(data)


def test_floats_are_refused() -> None:
    with pytest.raises(TypeError, match="integer"):
        ClockMap(0.0, 0, 0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="integer"):
        ClockMap(True, 0, 0)
    for times in (np.array([1.0]), np.array([1], np.uint64), 1.5):
        with pytest.raises(TypeError, match="int64"):
            IDENTITY.to_reference(times)  # type: ignore[call-overload]


@pytest.mark.parametrize("times", [2**62, np.array([0, 2**62])])
def test_overflow_is_an_error_and_not_a_wrap(times: int) -> None:
    with pytest.raises(OverflowError, match="int64"):
        ClockMap(0, 2**62, 0).to_reference(times)
    with pytest.raises(OverflowError, match="int64"):
        ClockMap(-(2**62), 0, 0).to_reference(times)
