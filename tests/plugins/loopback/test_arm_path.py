"""A simulated arm that a fake's motion moves: the world sees the ramps that it drives."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.plugins.loopback.arm_path import FakeArmPath
from sliplab.plugins.simulation.path import TOOL, TrueSurface
from sliplab.plugins.simulation.settings import MockSettings
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.storage.clockmap import ClockMap

PLANE = TrueSurface.from_settings(MockSettings().scene.contact)
HOME = PLANE.pose(0.0, 0.0, -5.0)
AHEAD_NS = 7_000_000_000
"""Reading of the controller's clock at true time 0."""


def path_of(ppb: int = 0) -> FakeArmPath:
    return FakeArmPath(PLANE, HOME, ClockMap.line(0, AHEAD_NS, ppb))


def away(x_mm: float, depth_mm: float = -5.0) -> Pose:
    return PLANE.pose(x_mm, 0.0, depth_mm)


def gone_mm(path: FakeArmPath, *t_s: float) -> list[float]:
    """Return the distance from home at true times."""
    states = path.commanded(np.array([round(t * 1e9) for t in t_s], np.int64))
    return [math.dist(state[:3], HOME.xyz_mm) for state in states]


def at(path: FakeArmPath, t_s: float) -> float:
    """That true time on the controller's clock, s."""
    return AHEAD_NS / 1e9 + t_s


def test_a_way_follows_its_ramps() -> None:
    path = path_of()
    path.motion.move(away(8.0), 4.0, 10.0, at(path, 1.0))
    # 0.4 s up over 0.8 mm, 1.6 s at 4 mm/s, 0.4 s down
    times = (0.0, 1.0, 1.2, 1.4, 2.0, 3.0, 3.2, 3.4, 9.0)
    expected = [0.0, 0.0, 0.2, 0.8, 3.2, 7.2, 7.8, 8.0, 8.0]
    assert gone_mm(path, *times) == pytest.approx(expected, abs=1e-6)
    assert [path.moving(round(t * 1e9)) for t in (0.9, 1.1, 3.3, 3.5)] == [
        False,
        True,
        True,
        False,
    ]


def test_a_short_way_never_comes_to_its_speed() -> None:
    path = path_of()
    path.motion.move(away(0.9), 40.0, 10.0, at(path, 0.0))
    assert gone_mm(path, 0.3, 0.6) == pytest.approx([0.45, 0.9], abs=1e-6)


def test_a_stop_brakes_on_the_way() -> None:
    path = path_of()
    path.motion.move(away(8.0), 4.0, 1e6, at(path, 0.0))
    path.motion.stop(8.0, at(path, 1.0))
    # from 4 mm/s at 4 mm: 0.5 s and 1 mm more
    expected = [2.0, 4.0, 4.75, 5.0, 5.0]
    assert gone_mm(path, 0.5, 1.0, 1.25, 1.5, 4.0) == pytest.approx(expected, abs=1e-4)
    assert not path.moving(1_600_000_000)


def test_a_way_may_be_extended_without_a_rest() -> None:
    path = path_of()
    path.motion.move(away(4.0), 4.0, 1e6, at(path, 0.0))
    assert path.motion.extend(away(8.0), 4.0, at(path, 0.5))
    assert gone_mm(path, 0.25, 1.0, 1.5, 2.1) == pytest.approx([1, 4, 6, 8], abs=1e-4)
    assert not path.motion.extend(away(8.0, -3.0), 4.0, at(path, 1.5))
    assert gone_mm(path, 2.1) == pytest.approx([8], abs=1e-4)


def test_a_trial_counts_from_its_begin_and_knows_where_the_arm_stands() -> None:
    path = path_of()
    path.motion.move(away(8.0), 4.0, 1e6, at(path, 0.0))
    path.begin(3_000_000_000)
    assert gone_mm(path, 0.0, 1.0) == pytest.approx([8, 8], abs=1e-6)
    path.motion.move(away(0.0), 4.0, 1e6, at(path, 3.5))
    assert gone_mm(path, 0.5, 1.0, 3.0) == pytest.approx([8, 6, 0], abs=1e-4)
    assert path.moving(600_000_000)
    path.begin(9_000_000_000)
    assert gone_mm(path, 0.0) == pytest.approx([0], abs=1e-6)


def test_a_trial_that_begins_on_the_way_keeps_the_way() -> None:
    path = path_of()
    path.motion.move(away(8.0), 4.0, 1e6, at(path, 0.0))
    path.begin(1_000_000_000)
    assert gone_mm(path, 0.0, 0.5, 2.0) == pytest.approx([4, 6, 8], abs=1e-4)


def test_the_world_can_stop_it_and_nobody_but_the_controller_moves_it() -> None:
    path = path_of()
    path.cut(5)
    path.cut(9)
    assert path.cut_ns == 5
    path.begin(100)
    assert path.cut_ns is None
    with pytest.raises(RigError, match="moved by its controller"):
        path.follow([Segment(away(1.0), 1.0)], 0)


def test_the_arm_trembles_while_it_moves() -> None:
    path = path_of()
    path.motion.move(away(4.0), 4.0, 1e6, at(path, 1.0))
    strength = path.tremor(np.array([0, 1_100_000_000, 1_900_000_000, 5_000_000_000], np.int64))
    assert strength == pytest.approx([0, 0.5, 1, 0], abs=0.01)


MOVES = st.lists(
    st.tuples(
        st.floats(-8, 8),
        st.floats(-6, 3),
        st.floats(1, 50),
        st.floats(50, 5000),
        st.floats(0.05, 3),
        st.booleans(),
    ),
    min_size=1,
    max_size=6,
)


@given(MOVES, st.integers(-200_000, 200_000))
def test_the_world_sees_what_the_controller_says_at_the_same_times(
    moves: list[tuple[float, float, float, float, float, bool]], ppb: int
) -> None:
    path, clock = path_of(ppb), ClockMap.line(0, AHEAD_NS, ppb)
    now, seen = 100_000_000, []
    for x, depth, speed, acceleration, seconds, stopped in moves:
        begin_s = clock.to_reference(now) / 1e9
        if path.motion.moving(begin_s):
            path.motion.stop(1000.0, begin_s)
        else:
            path.motion.move(away(x, depth), speed, acceleration, begin_s)
        for _ in range(4):
            now += round(seconds * 0.25e9)
            seen.append((now, path.motion.pose(clock.to_reference(now) / 1e9)))
        if stopped:
            path.motion.stop(500.0, clock.to_reference(now) / 1e9)
    states = path.commanded(np.array([t for t, _ in seen], np.int64), TOOL)
    for state, (_, pose) in zip(states, seen, strict=True):
        assert math.dist(state[:3], pose.xyz_mm) < 1e-4
