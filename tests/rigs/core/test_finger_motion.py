"""Fingers: reaction, ramps, stops and stalls."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.rigs.core.finger_motion import FingerMotion

MS = 1_000_000


def openings(fingers: FingerMotion, *times_ms: float) -> np.ndarray:
    return fingers.opening_mm(np.array([round(t * MS) for t in times_ms], np.int64))


def test_a_command_on_the_way_takes_over_from_rest_after_the_reaction() -> None:
    fingers = FingerMotion(40.0, 8 * MS, 1000.0)
    fingers.move(30.0, 100.0, 20.0, 0)
    before = openings(fingers, 8, 50)
    fingers.move(40.0, 100.0, 20.0, 50 * MS)
    np.testing.assert_array_equal(openings(fingers, 8, 50), before)  # the past stays
    turned = openings(fingers, 57, 58, 59)
    assert turned[0] > turned[1]  # it still closes while the fingers have not reacted
    assert turned[2] == pytest.approx(turned[1] + 0.5e-3)  # 1000 mm/s² for 1 ms
    assert openings(fingers, 1000)[0] == 40.0


def test_a_short_move_never_reaches_its_speed() -> None:
    fingers = FingerMotion(40.0, 0, 1000.0)
    fingers.move(39.6, 150.0, 20.0, 0)
    # up and down over 0.2 mm each: 2 sqrt(0.2 * 2 / 1000) s
    assert fingers.moving(39 * MS)
    assert not fingers.moving(41 * MS)
    assert openings(fingers, 20)[0] == pytest.approx(39.8)
    assert openings(fingers, 41)[0] == 39.6


def test_a_stop_brakes_within_the_way_that_the_speed_needs() -> None:
    fingers = FingerMotion(40.0, 8 * MS, 1000.0)
    fingers.move(20.0, 100.0, 20.0, 0)
    fingers.stop(150 * MS)  # at full speed, and reacts at 158
    here, rest = openings(fingers, 158, 1000)
    assert here - rest == pytest.approx(100.0**2 / 2 / 1000.0)
    assert openings(fingers, 159)[0] == pytest.approx(here - 0.1 + 0.5e-3)
    assert not fingers.moving(259 * MS)
    fingers.stop(300 * MS)
    assert openings(fingers, 1000)[0] == rest


def test_stalled_fingers_stay_until_the_next_move() -> None:
    fingers = FingerMotion(40.0, 0, 1000.0)
    fingers.move(30.0, 100.0, 7.0, 0)
    assert fingers.closing_force_n(0, MS) == 7.0
    held = openings(fingers, 60)[0]
    fingers.stall(60 * MS)
    assert fingers.stalled
    assert openings(fingers, 61, 5000) == pytest.approx(held)
    assert fingers.closing_force_n(60 * MS, 100 * MS) is None
    assert fingers.closing_force_n(59 * MS, 100 * MS) == 7.0
    fingers.move(35.0, 100.0, 9.0, 5000 * MS)
    assert not fingers.stalled
    # wider than where they stalled: nothing that opens has a force
    assert (held < 35.0) == (fingers.closing_force_n(5000 * MS, 5001 * MS) is None)


def test_times_count_on_after_a_restart() -> None:
    fingers, other = FingerMotion(40.0, 0, 1000.0), FingerMotion(40.0, 0, 1000.0)
    for each in (fingers, other):
        each.move(30.0, 100.0, 20.0, 0)
    other.restart(60 * MS)
    np.testing.assert_allclose(openings(other, 0, 20, 900), openings(fingers, 60, 80, 960))
