"""A fake's tool centre point goes straight, at constant speed, and stops on its line."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.fake_motion import Ramp, StraightMotion, running_clock

A, B = Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), Pose((15.0, 0.0, 0.0), (0.0, 0.0, 90.0))


def xs(motion: StraightMotion, times: np.ndarray) -> np.ndarray:
    return np.array([motion.pose(float(t)).xyz_mm[0] for t in times])


def test_a_ramp_covers_its_length_in_its_time() -> None:
    for ramp in (Ramp(15, 1.6, 100), Ramp(0.01, 10, 100)):  # long, and too short for its speed
        t = np.linspace(0, ramp.seconds, 20_001)
        speed = np.array([ramp.at(float(s))[1] for s in t])
        assert np.trapezoid(speed, t) == pytest.approx(ramp.length, rel=1e-4)
        assert ramp.at(ramp.seconds)[0] == ramp.length
        assert speed.max() <= ramp.speed + 1e-9


def test_a_move_is_at_constant_speed_and_turns_evenly() -> None:
    motion = StraightMotion(A)
    motion.move(B, 1.6, 100.0, 5.0)
    t = np.linspace(6, 13, 50)
    assert np.diff(xs(motion, t)) / np.diff(t) == pytest.approx(1.6)
    half = next(
        float(s) for s in np.linspace(5, 15, 10_001) if motion.pose(float(s)).xyz_mm[0] > 7.5
    )
    assert motion.pose(half).rotvec_deg[2] == pytest.approx(45, abs=0.1)
    assert motion.moving(14.0)
    assert not motion.moving(15.0)
    assert motion.pose(15.0) == B


@pytest.mark.parametrize("at_s", [5.001, 5.2, 9.0, 14.37, 20.0])
def test_a_stop_has_no_jump_and_keeps_to_the_line(at_s: float) -> None:
    motion, free = StraightMotion(A), StraightMotion(A)
    for each in (motion, free):
        each.move(B, 1.6, 10.0, 5.0)
    speed = (free.pose(at_s + 1e-6).xyz_mm[0] - free.pose(at_s - 1e-6).xyz_mm[0]) / 2e-6
    motion.stop(4.0, at_s)
    after = xs(motion, np.linspace(at_s, at_s + 1, 2001))
    assert after[0] == pytest.approx(free.pose(at_s).xyz_mm[0], abs=1e-6)
    assert (after[1] - after[0]) / 5e-4 == pytest.approx(speed, abs=0.01)
    assert np.all(np.diff(after) >= -1e-9)
    assert after[-1] - after[0] == pytest.approx(min(speed**2 / 8, 15 - after[0]), abs=1e-3)
    assert not motion.moving(at_s + 1)


def test_a_line_may_be_extended_on_its_way_and_only_straight_on() -> None:
    motion = StraightMotion(A)
    motion.move(Pose((1.0, 0.0, 0.0), A.rotvec_deg), 1.0, 100.0, 0.0)
    further = Pose((3.0, 0.0, 0.0), A.rotvec_deg)
    assert not motion.extend(Pose((1.0, 2.0, 0.0), A.rotvec_deg), 1.0, 0.5)  # round a corner
    assert not motion.extend(further, 2.0, 0.5)  # at another speed
    assert motion.extend(further, 1.0, 0.5)
    t = np.linspace(0.1, 2.9, 100)
    assert np.diff(xs(motion, t)) / np.diff(t) == pytest.approx(1.0)
    assert not motion.extend(further, 1.0, 5.0)  # it rests
    assert motion.pose(5.0) == further


def test_a_fast_clock_runs_at_its_rate() -> None:
    host = iter([10.0, 10.0, 12.0])
    clock = running_clock(5.0, 100.0, lambda: next(host))
    assert clock.now_s() == 100.0
    assert clock.now_s() == 110.0
