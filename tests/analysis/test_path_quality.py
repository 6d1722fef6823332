"""The speed along a path, from poses: noisy, sparse, late, and of arms that did not keep it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from sliplab.analysis.quality import path_deviation_mm, speed_deviation_percent
from sliplab.storage.streams import F64, I64, PathSegment
from tests.patching import loose

LIMIT_PERCENT = 10.0
"""The gate's default."""
LENGTH_MM = 15.0
Path = Callable[[F64], F64]


def steady(speed: float) -> Path:
    """Distance gone, mm, over time, s: no ramps."""
    return lambda t: np.clip(speed * t, 0.0, LENGTH_MM)


def ramped(speed: float, acceleration: float) -> Path:
    """Gathers speed and loses it evenly."""
    up = speed / acceleration
    end = LENGTH_MM / speed + up

    def gone(t: F64) -> F64:
        left = np.clip(end - t, 0.0, None)
        middle = speed * (t - up / 2)
        late = np.where(left < up, LENGTH_MM - acceleration * left**2 / 2, middle)
        return np.where(t < up, acceleration * t**2 / 2, late)

    return gone


def slow_in(speed: float, ratio: float, begin_mm: float, end_mm: float) -> Path:
    """At a share of its speed between two places, and at its speed elsewhere."""
    places = np.array([0.0, begin_mm, end_mm, LENGTH_MM])
    speeds = np.array([speed, speed * ratio, speed])
    times = np.concatenate([[0.0], np.cumsum(np.diff(places) / speeds)])
    return lambda t: np.interp(t, times, places)


def poses(
    gone: Path, rate: float = 500.0, noise_mm: float = 0.002, seed: int = 1
) -> tuple[I64, F64, PathSegment, float]:
    """Times and places of a motion, its segment (without speed), and the time of its last pose."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 120.0, 1 / rate)
    t = t[: int(np.argmax(gone(t) >= LENGTH_MM - 1e-9)) + 1]
    direction = np.array([0.6, -0.8, 0.0])
    place = gone(t)[:, None] * direction + rng.normal(0.0, noise_mm, (len(t), 3))
    ns = 7_000_000_000 + np.rint(t * 1e9).astype(np.int64)
    end = LENGTH_MM * direction
    segment = PathSegment(int(ns[0]), int(ns[-1]), (0.0, 0.0, 0.0), (end[0], end[1], end[2]))
    return ns, place, segment, float(t[-1])


def deviation(gone: Path, speed: float, **how: float) -> float:
    """Of poses on the controller's clock that arrive 1 ms later."""
    ns, place, segment, _ = loose(poses)(gone, **how)
    segment = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.end_mm, speed)
    return speed_deviation_percent(ns, ns + 1_000_000, place, [segment])


@pytest.mark.parametrize("speed", [0.2, 0.6, 1.6, 10.0, 40.0])
@pytest.mark.parametrize("noise_mm", [0.0, 0.002, 0.02])
def test_a_steady_motion_passes_whatever_its_noise(speed: float, noise_mm: float) -> None:
    for seed in range(5):
        assert deviation(steady(speed), speed, noise_mm=noise_mm, seed=seed) < LIMIT_PERCENT / 2


@pytest.mark.parametrize(
    ("speed", "acceleration"), [(0.6, 100.0), (1.6, 100.0), (10.0, 100.0), (20.0, 100.0)]
)
def test_the_ramps_at_both_ends_are_left_out(speed: float, acceleration: float) -> None:
    assert deviation(ramped(speed, acceleration), speed) < LIMIT_PERCENT / 2


@pytest.mark.parametrize("rate", [4.0, 50.0, 250.0, 500.0])
def test_half_the_speed_all_along_is_seen(rate: float) -> None:
    assert deviation(steady(0.8), 1.6, rate=rate) == pytest.approx(50.0, abs=2.0)
    assert deviation(steady(3.2), 1.6, rate=rate) == pytest.approx(100.0, abs=4.0)


@pytest.mark.parametrize("begin_mm", [1.0, 4.3, 7.1, 11.0])
def test_half_the_speed_in_a_part_of_the_path_is_seen(begin_mm: float) -> None:
    """2 mm of 15 at 50 %: the whole takes 13 % longer."""
    assert deviation(slow_in(1.6, 0.5, begin_mm, begin_mm + 2.0), 1.6) > 40.0


def test_a_duration_that_comes_out_right_hides_nothing() -> None:
    """At 80 % for the first half, then so fast that the whole takes no longer."""
    half, seconds = LENGTH_MM / 2, LENGTH_MM / 1.6
    later = half / (seconds - half / (0.8 * 1.6))

    def gone(t: F64) -> F64:
        begun = 0.8 * 1.6 * t
        over = half + later * (t - half / (0.8 * 1.6))
        return np.clip(np.where(begun < half, begun, over), 0.0, LENGTH_MM)

    ns, place, segment, took_s = poses(gone)
    assert took_s == pytest.approx(seconds, abs=0.01)
    segment = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.end_mm, 1.6)
    assert path_deviation_mm(ns, place, [segment]) < 0.02
    assert speed_deviation_percent(ns, ns + 1, place, [segment]) > 19.0


def test_a_halt_is_seen() -> None:
    def gone(t: F64) -> F64:
        return np.clip(1.6 * np.where(t < 3.0, t, np.maximum(t - 0.6, 3.0)), 0.0, LENGTH_MM)

    assert deviation(gone, 1.6) > 90.0


def test_poses_timed_by_a_busy_hosts_arrival_pass() -> None:
    """Mostly some ms late; now and then nothing is read for 60 ms, and then all at once."""
    rng = np.random.default_rng(3)
    ns, place, segment, took_s = poses(steady(1.6), rate=250.0)
    arrived = ns + np.rint(rng.exponential(3e6, len(ns))).astype(np.int64)
    for stall_s in np.arange(0.7, took_s, 1.3):
        begin = ns[0] + round(stall_s * 1e9)
        held = (arrived > begin) & (arrived < begin + 60_000_000)
        arrived[held] = begin + 60_000_000
    arrived = np.maximum.accumulate(arrived)
    segment = PathSegment(int(arrived[0]), int(arrived[-1]), segment.begin_mm, segment.end_mm, 1.6)
    assert speed_deviation_percent(arrived, arrived, place, [segment]) < LIMIT_PERCENT / 2
    slow = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.end_mm, 3.2)
    assert speed_deviation_percent(arrived, arrived, place, [slow]) == pytest.approx(50, abs=5)


def test_a_gap_in_the_poses_hides_nothing() -> None:
    ns, place, segment, _ = poses(slow_in(1.6, 0.5, 6.0, 8.0))
    kept = (ns < ns[0] + 3_700_000_000) | (ns > ns[0] + 6_300_000_000)
    segment = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.end_mm, 1.6)
    found = speed_deviation_percent(ns[kept], ns[kept] + 1, place[kept], [segment])
    assert found > 2 * LIMIT_PERCENT


@pytest.mark.parametrize("what", ["no poses", "one pose", "falls back", "never leaves", "one time"])
def test_what_cannot_be_told_is_said(what: str) -> None:
    ns, place, segment, _ = poses(steady(1.6))
    segment = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.end_mm, 1.6)
    if what == "no poses":
        ns, place = ns[:0], place[:0]
    elif what == "one pose":
        ns, place = ns[:1], place[:1]
    elif what == "falls back":
        ns = np.where(np.arange(len(ns)) > 1000, ns - 500_000_000, ns)
    elif what == "never leaves":
        place = np.zeros_like(place)
    else:
        ns = np.full_like(ns, ns[5])
    assert speed_deviation_percent(ns, ns + 1, place, [segment]) == -1.0 or what == "never leaves"
    if what == "never leaves":
        assert not 0 <= speed_deviation_percent(ns, ns + 1, place, [segment]) <= LIMIT_PERCENT


def test_standing_still_has_no_speed() -> None:
    ns, place, segment, _ = poses(steady(1.6))
    rest = PathSegment(segment.start_ns, segment.end_ns, segment.begin_mm, segment.begin_mm)
    assert speed_deviation_percent(ns, ns + 1, place, [rest]) == 0.0
