"""Starts and ends of segments, told from commanded poses alone."""

from __future__ import annotations

import pytest

from sliplab.rigs.core.capabilities import Pose, Segment
from sliplab.rigs.core.fake_motion import StraightMotion
from sliplab.rigs.core.threaded_arm import SegmentWatch

A = Pose((0.0, 0.0, 0.0), (180.0, 0.0, 0.0))
PERIOD_S = 0.004


def watch(path: list[Segment], pause_s: float = 0.05) -> list[tuple[float, float]]:
    """Return the segment times that a watch finds, s; each begins after the previous has rested."""
    motion, seen = StraightMotion(A), SegmentWatch(A, path)
    t, todo, free_s, found = 0.0, list(path), 1.0, []
    while not seen.done and t < 60:
        t += PERIOD_S
        if todo and t >= free_s and not motion.moving(t):
            segment = todo.pop(0)
            motion.move(segment.to, segment.speed_mm_s, 500.0, t)
            ramp_s = 1e9 if motion.moving(t) else 0.0
            free_s = t + ramp_s
        if not motion.moving(t) and free_s > 1e8:
            free_s = t + pause_s
        times = seen.add(round(t * 1e9), motion.pose(t))
        if times is not None:
            found.append((times[0] / 1e9, times[1] / 1e9))
    return found


@pytest.mark.parametrize("speed", [0.2, 0.6, 1.6, 40.0])
def test_a_segment_is_timed_to_a_few_samples(speed: float) -> None:
    ((start, end),) = watch([Segment(Pose((5.0, 0.0, 0.0), A.rotvec_deg), speed)])
    assert start == pytest.approx(1.0, abs=3 * PERIOD_S)
    assert end - start == pytest.approx(5 / speed + speed / 500, abs=4 * PERIOD_S)


def test_segments_do_not_overlap_and_the_rest_between_them_is_seen() -> None:
    there = Pose((5.0, 0.0, 0.0), A.rotvec_deg)
    first, second = watch([Segment(there, 20.0), Segment(A, 10.0)])
    assert second[0] - first[1] == pytest.approx(0.05, abs=4 * PERIOD_S)


def test_a_turn_on_the_spot_is_a_segment() -> None:
    assert len(watch([Segment(Pose(A.xyz_mm, (180.0, 0.0, 20.0)), 10.0)])) == 1
