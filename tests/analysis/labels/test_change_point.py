"""Change points of drawn slips whose beginning is known."""

from __future__ import annotations

import numpy as np
import pytest
from mpmath import mp

from sliplab.analysis.labels.change_point import (
    ChangePoint,
    _evidence,
    change_point,
    departure,
)
from sliplab.analysis.labels.slip_times import slip_times

PERIOD = 10_000_000
START = 40
NOISE = 0.004
Slip = tuple[np.ndarray, np.ndarray, np.ndarray]


def slip(
    at: float,
    rng: np.random.Generator,
    *,
    speed: float = 0.2,
    jerk: float = 0.0,
    wander: float = 0.02,
    exposure: float = 0.2,
    n: int = 100,
) -> Slip:
    """Times, offsets and their standard deviation of a marker that lets go at frame `at`.

    Its velocity wanders from there on; a place is the mean over the exposure (shares of a frame).
    """
    fine = 200
    t = np.arange(n * fine) / fine
    since = np.maximum(t - at, 0.0)
    kicks = rng.normal(0, wander * speed / np.sqrt(fine), len(t)) * (since > 0)
    velocity = np.where(since > 0, np.maximum(speed + np.cumsum(kicks), 0.0), 0.0)
    way = np.cumsum(velocity) / fine + jerk * (1 - np.exp(-since / 1.5))
    half = int(exposure * fine / 2)
    frames = np.arange(1, n) * fine
    places = np.array([way[i - half : i + half + 1].mean() for i in frames])
    away = places[:, None] * np.array([0.6, 0.8]) + rng.normal(0, NOISE, (n - 1, 2))
    return (np.arange(1, n) * PERIOD).astype(np.int64), away, np.full(n - 1, NOISE)


def found(drawn: Slip, first: int = 10) -> ChangePoint:
    """Its change point."""
    frame_ns, away, sigma = drawn
    left = departure(away, sigma, first)
    assert left is not None
    result = change_point(frame_ns, away, sigma, left, 2_000_000)
    assert result is not None
    return result


def test_a_slip_between_two_frames_is_dated_to_a_millisecond() -> None:
    rng = np.random.default_rng(1)
    for share in (0.0, 0.25, 0.5, 0.75):
        point = found(slip(START + share, rng, speed=0.3))
        assert abs(point.at_ns / PERIOD - START - share) < 0.1
        assert point.low_ns <= point.at_ns <= point.high_ns


@pytest.mark.quick(1)
@pytest.mark.parametrize("jerk", [0.0, 0.15])
def test_its_intervals_hold_the_truth_as_often_as_they_say(jerk: float) -> None:
    rng = np.random.default_rng(2)
    at = START + rng.uniform(0, 1, 80)
    points = [found(slip(v, rng, jerk=jerk, wander=0.1)) for v in at]
    low, middle, high = (
        np.array([getattr(p, name) for p in points]) / PERIOD
        for name in ("low_ns", "at_ns", "high_ns")
    )
    # 95 % of 80: 4 outside, give or take 2
    assert ((low <= at) & (at <= high)).sum() >= 72
    assert np.median(np.abs(middle - at)) < 0.06
    assert np.median(high - low) < 0.6


def test_frames_that_miss_widen_the_interval() -> None:
    frame_ns, away, sigma = slip(START + 0.4, np.random.default_rng(3))
    whole = found((frame_ns, away, sigma))
    away[START - 2 : START + 2] = np.nan
    hidden = found((frame_ns, away, sigma))
    assert hidden.high_ns - hidden.low_ns > 2 * (whole.high_ns - whole.low_ns)
    assert hidden.low_ns <= (START + 0.4) * PERIOD <= hidden.high_ns


def test_noise_and_drift_are_no_departure() -> None:
    rng = np.random.default_rng(4)
    still = rng.normal(0, NOISE, (300, 2))
    sigma = np.full(300, NOISE)
    assert departure(still, sigma, 20) is None
    assert departure(still + np.linspace(0, 0.3, 300)[:, None], sigma, 20) is None
    still[150] += 5.0  # a single outlier is none either
    assert departure(still, sigma, 20) is None
    assert departure(np.full((9, 2), np.nan), sigma[:9], 2) is None


def test_a_papilla_that_creeps_over_the_line_is_doubted() -> None:
    rng = np.random.default_rng(5)
    creep = np.linspace(0, 3.0, 2000)[:, None, None] * np.array([1.0, 0.0])
    away = creep + rng.normal(0, NOISE, creep.shape)
    frame_ns = (np.arange(2000) * PERIOD).astype(np.int64)
    times = slip_times(frame_ns, away, np.full((2000, 1), NOISE), 0, 0, 2_000_000, 2.0)
    assert times.at_ns[0] > 0
    assert times.doubts().gross is not None


def test_slips_of_a_trial() -> None:
    rng = np.random.default_rng(6)
    drawn = [slip(at, rng) for at in (60.3, 30.5, 200.0)]
    away = np.stack([one[1] for one in drawn], axis=1)
    sigma = np.full(away.shape[:2], NOISE)
    times = slip_times(drawn[0][0], away, sigma, 0, 5 * PERIOD, 2_000_000, 2.0)
    onsets = times.onsets
    assert onsets.first_marker == 1
    assert onsets.incipient_ns == times.at_ns[1]
    assert onsets.gross_ns == times.at_ns[0]
    assert times.at_ns[2] == -1
    assert times.doubts().incipient is times.doubts().gross is None
    assert abs(times.at_ns[1] / PERIOD - 30.5) < 0.1


def evidence(table: np.ndarray, k: int) -> float:
    """Return `_evidence` by inverse and determinant with 60 digits."""
    with mp.workdps(60):
        x = mp.matrix(table[:, [0, 1, 2 + k]].tolist())
        y = mp.matrix(table[:, -1].tolist())
        normal, right = x.T * x + mp.mpf("1e-9") * mp.eye(3), x.T * y
        inverse = normal**-1
        best = inverse * right
        said = -((y.T * y)[0] - (right.T * best)[0]) / 2 - mp.log(mp.det(normal)) / 2
        for a in (1, 2):
            said += mp.log(mp.ncdf(best[a] / mp.sqrt(inverse[a, a])))
        return float(said)


@pytest.mark.parametrize("case", ["plain", "no frame after the slip", "one direction", "nearly"])
def test_what_is_integrated_out_agrees_with_sixty_digits(case: str) -> None:
    rng = np.random.default_rng(5)
    for _ in range(20):
        table = rng.normal(0.0, 100.0, (18, 9))
        table[:, -1] = table[:, 0] + table[:, 1] + rng.normal(0.0, 1.0, 18)
        if case == "no frame after the slip":
            table[:, 1:-1] = 0.0
        elif case == "one direction":  # a relief so long that it is a straight line
            table[:, 2:-1] = table[:, 1:2]
        elif case == "nearly":
            table[:, 2:-1] = table[:, 1:2] * (1.0 + rng.normal(0.0, 1e-5, (18, 6)))
        # what rounding leaves of a column's square, 1e-11, is beside the ridge of 1e-9
        digits = 1e-9 if case in {"plain", "no frame after the slip"} else 0.05
        assert _evidence(table, 3) == pytest.approx(evidence(table, 3), abs=digits, rel=1e-9)
