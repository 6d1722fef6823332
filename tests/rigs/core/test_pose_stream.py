"""Which poses of a controller are believed: what an arm can reach in the time that has passed."""

from __future__ import annotations

import math
from typing import Any

import pytest

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import angle_deg
from sliplab.rigs.core.pose_stream import PoseCheck, PoseJumpError, _turn_deg

MS = 1_000_000
DOWN = (180.0, 0.0, 0.0)


def at(y_mm: float, rotvec_deg: tuple[float, float, float] = DOWN) -> Pose:
    return Pose((400.0, y_mm, 300.0), rotvec_deg)


@pytest.fixture
def check() -> PoseCheck:
    """A check that has seen nothing."""
    return PoseCheck()


def test_slide_is_believed(check: PoseCheck) -> None:
    assert all(check.believes(4 * MS * n, 4 * MS * n, at(0.16 * n)) for n in range(500))
    assert check.dropped == 0


def test_fast_path_is_believed_up_to_twice_its_limit() -> None:
    for speed, believed in ((1900.0, True), (5000.0, False)):
        check = PoseCheck(limit_mm_s=1000.0)
        check.believes(0, 0, at(0.0))
        assert check.believes(20 * MS, 20 * MS, at(speed * 0.02)) is believed


@pytest.mark.parametrize("pose", [at(999.0), at(0.0, (0.0, 180.0, 0.0)), at(math.nan)])
def test_single_jump_is_dropped_and_a_second_one_is_a_fault(check: PoseCheck, pose: Pose) -> None:
    assert check.believes(0, 0, at(0.0))
    assert not check.believes(4 * MS, 4 * MS, pose)
    assert check.believes(8 * MS, 8 * MS, at(0.0))
    assert not check.believes(12 * MS, 12 * MS, pose)
    if math.isfinite(pose.xyz_mm[1]):
        with pytest.raises(PoseJumpError, match="its pose jumped by"):
            check.believes(16 * MS, 16 * MS, pose)
        assert check.dropped == 3


def test_two_vectors_of_one_rotation_are_no_turn(check: PoseCheck) -> None:
    assert check.believes(0, 0, at(0.0, (179.99, 0.0, 0.0)))
    assert check.believes(2 * MS, 2 * MS, at(0.0, (-179.99, 0.0, 0.0)))
    assert check.believes(4 * MS, 4 * MS, at(0.0, (180.01, 0.0, 0.0)))


def test_time_on_one_clock_alone_does_not_explain_a_jump(check: PoseCheck) -> None:
    assert check.believes(0, 0, at(0.0))
    assert not check.believes(900 * MS, 4 * MS, at(500.0))
    assert not check.believes(8 * MS, 900 * MS, at(500.0))
    assert check.believes(900 * MS, 900 * MS, at(500.0))


def test_inactive_check_believes_every_jump_and_follows_it(check: PoseCheck) -> None:
    check.active = False
    assert check.believes(0, 0, at(0.0))
    assert check.believes(4 * MS, 4 * MS, at(120.0))
    check.active = True
    assert check.believes(8 * MS, 8 * MS, at(120.0))


@pytest.mark.parametrize(
    ("one", "other"),
    [((0.0, 0.0, 0.0), (0.0, 0.0, 1e-3)), (DOWN, (0.0, 180.0, 0.0)), ((9.0, -3.0, 50.0), DOWN)],
)
def test_turn_is_the_angle_between_two_rotations(one: Any, other: Any) -> None:
    assert _turn_deg(one, other) == pytest.approx(angle_deg(at(0, one), at(0, other)), abs=1e-6)


def test_third_jump_in_a_row_is_a_fault_wherever_it_leads(check: PoseCheck) -> None:
    """Poses from a buffer that holds anything never agree, and are no life either."""
    assert check.believes(0, 0, at(0.0))
    assert not check.believes(2 * MS, 2 * MS, at(900.0))
    assert not check.believes(4 * MS, 4 * MS, at(-900.0))
    with pytest.raises(PoseJumpError, match="jumped by 900"):
        check.believes(6 * MS, 6 * MS, at(900.0))
