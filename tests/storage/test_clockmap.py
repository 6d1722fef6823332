"""The clock map against Python's big integers, at the sizes where floats and int64 give way."""

from __future__ import annotations

import json
from fractions import Fraction
from math import floor
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.storage.clockmap import BILLION, DRIFT_UNITS, IDENTITY, MAX_DRIFT, ClockMap
from tests.patching import loose

DRIFTS = st.integers(-(10**17), 10**17) | st.integers(-(10**8), 10**8).map(lambda d: d * BILLION)
TIMES = st.integers(-(2**62), 2**62)
SPANS = st.integers(-(2**61), 2**61)
HOURS = st.integers(-(10**13), 10**13)
NINE_YEARS = st.integers(-(2**58), 2**58)


def line(device: int, reference: int, drift: int) -> ClockMap:
    return ClockMap((device,), (reference,), (drift,))


def exact(clock: ClockMap, device: int) -> Fraction:
    d = device - clock.device_ns[0]
    return clock.reference_ns[0] + d * (1 + Fraction(clock.drift[0], DRIFT_UNITS))


def half_up(value: Fraction) -> int:
    return floor(value + Fraction(1, 2))


@given(
    anchor=TIMES,
    image=SPANS,
    drift=DRIFTS,
    spans=st.lists(SPANS, min_size=1, max_size=20) | st.lists(HOURS, min_size=1, max_size=20),
)
def test_a_time_is_the_exact_one_rounded(anchor: int, image: int, drift: int, spans: Any) -> None:
    clock = line(anchor, image, drift)
    times = [max(-(2**63), min(2**63 - 1, anchor + span)) for span in spans]
    expected = [half_up(exact(clock, time)) for time in times]
    assert [clock.to_reference(time) for time in times] == expected
    assert clock.to_reference(np.array(times, np.int64)).tolist() == expected
    # many times are mapped by arrays
    assert clock.to_reference(np.array(times * 9, np.int64)).tolist() == expected * 9


@given(anchor=TIMES, image=SPANS, drift=DRIFTS, spans=st.lists(NINE_YEARS, min_size=1, max_size=20))
def test_there_and_back_in_a_nanosecond(anchor: int, image: int, drift: int, spans: Any) -> None:
    clock = line(anchor, image, drift)
    times = np.array([max(-(2**63), min(2**63 - 1, anchor + span)) for span in spans], np.int64)
    back = clock.to_device(clock.to_reference(times))
    assert max(abs(int(a) - int(b)) for a, b in zip(back, times, strict=True)) <= 1
    assert back.tolist() == [clock.to_device(clock.to_reference(int(t))) for t in times]
    references = image + (times - anchor)
    forth = clock.to_reference(clock.to_device(references))
    assert np.abs(forth - references).max() <= 1


@given(base=st.sampled_from([2**53, 2**62]), drift=DRIFTS, step=st.integers(2, 10_000))
def test_order_is_kept_where_floats_lose_it(base: int, drift: int, step: int) -> None:
    times = base + np.arange(0, 64 * step, step, dtype=np.int64)
    for clock in (line(base - 10**15, base - 7, drift), line(base, 0, drift)):
        mapped = clock.to_reference(times)
        assert (np.diff(mapped) > 0).all()
        # neighbours never swap either
        assert (np.diff(clock.to_reference(base + np.arange(1000))) >= 0).all()


def test_a_nanosecond_stays_distinct_without_drift() -> None:
    for base in (2**53, 2**62):
        mapped = ClockMap.line(base, 0).to_reference(np.array([base, base + 1]))
        assert mapped.tolist() == [0, 1]


def test_known_values() -> None:
    clock = ClockMap.line(1_000, 5_000, 100_000)  # 100 ppm
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
    times = 2**53 + np.arange(20, dtype=np.int64) * 10**9 + rest
    clock = ClockMap.line(2**53, 0, drift)
    assert clock.to_reference(times).tolist() == [half_up(exact(clock, int(t))) for t in times]


def test_shapes_and_kinds() -> None:
    clock = ClockMap.line(0, 10)
    assert clock.to_reference(np.zeros((2, 3), np.int64)).shape == (2, 3)
    assert clock.to_reference(np.empty(0, np.int64)).dtype == np.int64
    assert clock.to_reference(np.array([1], np.uint32)).dtype == np.int64
    assert type(clock.to_reference(np.int64(1))) is int
    source = np.arange(5)
    clock.to_reference(source)
    assert source.tolist() == [0, 1, 2, 3, 4]


@st.composite
def bent(draw: st.DrawFn) -> ClockMap:
    """Up to six pieces, of a second to a day, anywhere in int64."""
    runs = draw(st.lists(st.integers(10**9, 10**14), min_size=1, max_size=6))
    device = [draw(st.integers(-(2**60), 2**60))]
    reference = [draw(st.integers(-(2**60), 2**60))]
    for run in runs:
        device.append(device[-1] + run)
        gained = draw(st.integers(-(2 * 10**7), 2 * 10**7)) * run // 10**9
        reference.append(reference[-1] + run + gained)
    return ClockMap.through(device, reference)


@given(clock=bent(), data=st.data())
def test_a_bent_map_meets_its_knots_keeps_order_and_comes_back(clock: ClockMap, data: Any) -> None:
    assert clock.to_reference(np.array(clock.device_ns)).tolist() == list(clock.reference_ns)
    near = data.draw(st.sampled_from(clock.device_ns))
    times = near + np.arange(-500, 500, dtype=np.int64)
    mapped = clock.to_reference(times)
    assert (np.diff(mapped) >= 0).all()
    assert mapped.tolist() == [clock.to_reference(int(t)) for t in times]
    far = np.sort(near + np.array(data.draw(st.lists(NINE_YEARS, min_size=2, max_size=20))))
    assert (np.diff(clock.to_reference(far)) >= 0).all()
    assert np.abs(clock.to_device(clock.to_reference(far)) - far).max() <= 1
    assert clock.inverse.inverse.device_ns == clock.device_ns


@given(
    first=bent() | st.integers(-(2**60), 2**60).map(lambda t: ClockMap.line(t, 0, -70_000)),
    after=bent(),
    apart=st.integers(-(10**16), 10**16),
    span=NINE_YEARS,
)
def test_two_maps_in_a_row_are_one(first: ClockMap, after: ClockMap, apart: int, span: int) -> None:
    # the second one's knots at most months from the first one's, as all of a campaign are: over
    # decades the unit of a drift comes to nanoseconds
    move = first.reference_ns[0] + apart - after.device_ns[0]
    after = ClockMap(tuple(t + move for t in after.device_ns), after.reference_ns, after.drift)
    both = first.then(after)
    knots = [*first.device_ns, *(first.to_device(t) for t in after.device_ns)]
    times = [knot + offset for knot in knots for offset in (-1, 0, 1, 10**10, span)]
    for time in times:
        assert abs(both.to_reference(time) - after.to_reference(first.to_reference(time))) <= 2
    # and back again, to the nanosecond
    returned = both.inverse.then(first).then(after)
    for time in times:
        image = both.to_reference(time)
        assert abs(returned.to_reference(image) - image) <= 4


def test_a_slow_clock_shows_one_time_twice_and_maps_in_a_row_are_not_taken_in_by_it() -> None:
    # at -2 % the nanosecond before the knot may have the knot's own image: found at 136 ms
    first = ClockMap.line(-1009, 4830, -20_000_001)
    after = ClockMap.through(
        [-42_219, 13_720_629_996, 17_584_823_391], [231_546, 13_720_906_642, 17_585_099_043]
    )
    for move in range(200):
        second = ClockMap(tuple(t + move for t in after.device_ns), after.reference_ns, after.drift)
        both = first.then(second)
        for time in (-1010, 0, 10**9):
            assert abs(both.to_reference(time) - second.to_reference(first.to_reference(time))) <= 2


def test_pieces_must_join_and_rise() -> None:
    clock = ClockMap.through([0, 10**9, 3 * 10**9], [0, 10**9 + 7, 3 * 10**9 + 7])
    assert clock.drift == (7 * BILLION, 0)
    assert clock.drift_ppm(5) == pytest.approx(7e-3)
    assert clock.drift_ppm(2 * 10**9) == 0.0
    with pytest.raises(ValueError, match="ends at"):
        ClockMap((0, 10**9), (0, 10**9 + 1), (0, 0))
    with pytest.raises(ValueError, match="rise"):
        ClockMap((5, 5), (0, 0), (0, 0))
    with pytest.raises(ValueError, match="as many"):
        ClockMap((5,), (0, 0), (0,))
    with pytest.raises(TypeError, match="integers"):
        loose(ClockMap)(5, 0, 0)


def test_json_keeps_every_bit() -> None:
    for clock in (
        ClockMap.line(2**62 + 1, -(2**53) - 1, -99_999),
        ClockMap.through([0, 10**10, 3 * 10**10], [2**62, 2**62 + 10**10 + 1, 2**62 + 3 * 10**10]),
    ):
        assert ClockMap.from_json(json.loads(json.dumps(clock.to_json()))) == clock


@pytest.mark.parametrize(
    "changes",
    [{"drift": None}, {"drift_ppm": [0]}, {"drift": [MAX_DRIFT + 1]}, {"device_ns": [2**63]}],
)
def test_bad_fields_are_refused(changes: dict[str, Any]) -> None:
    data = {"device_ns": [0], "reference_ns": [0], "drift": [0], **changes}
    data = {name: values for name, values in data.items() if values is not None}
    with pytest.raises(ValueError, match=r"fields|ClockMap"):
        ClockMap.from_json(data)


def test_floats_are_refused() -> None:
    with pytest.raises(TypeError, match="integer"):
        loose(ClockMap)((0.0,), (0,), (0,))
    with pytest.raises(TypeError, match="integer"):
        ClockMap((True,), (0,), (0,))
    for times in (np.array([1.0]), np.array([1], np.uint64), 1.5):
        with pytest.raises(TypeError, match="int64"):
            loose(IDENTITY).to_reference(times)


@pytest.mark.parametrize("times", [2**62, np.array([0, 2**62]), np.array(10 * [2**62])])
def test_overflow_is_an_error_and_not_a_wrap(times: int) -> None:
    with pytest.raises(OverflowError, match="int64"):
        ClockMap.line(0, 2**62).to_reference(times)
    with pytest.raises(OverflowError, match="int64"):
        ClockMap.line(-(2**62), 0).to_reference(times)
