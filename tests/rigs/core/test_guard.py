"""Every limit stops a move before anything is sent, and says what it held against what."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from sliplab.rigs.core.arm_settings import Limits
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.guard import (
    DepthError,
    Guard,
    GuardError,
    SingularityError,
    SpeedError,
    TiltError,
    WorkspaceError,
)

DOWN = (180.0, 0.0, 0.0)
BEGIN = Pose((400.0, 0.0, 300.0), DOWN)
BOX: dict[str, Any] = {"low_mm": (300, -50, 200), "high_mm": (500, 50, 400)}
# a plate whose x is the base's y, whose y is up, and into which the base's x points
PLATE = {"centre_mm": (450, 0, 300), "right_mm": (450, 20, 300), "above_mm": (450, 0, 320)}


def guard(**more: Any) -> Guard:
    return Guard(Limits(**{**BOX, **more}))


def to(x: float, y: float, z: float, speed: float = 10.0, rotvec: Any = DOWN) -> Segment:
    return Segment(Pose((x, y, z), rotvec), speed)


def test_a_path_within_all_limits_passes() -> None:
    guard(tilt_deg=5).check(BEGIN, [to(500, 50, 400), to(300, -50, 200)])


@pytest.mark.parametrize(
    ("segment", "error", "value", "limit"),
    [
        (to(500.5, 0, 300), WorkspaceError, 500.5, 500),
        (to(400, -51, 300), WorkspaceError, -51, -50),
        (to(400, 0, 300, speed=51), SpeedError, 51, 50),
        (to(400, 0, 300, speed=0), SpeedError, 0, 50),
        (to(400, 0, 300, rotvec=(90.0, 0.0, 0.0)), TiltError, 90, 45),
    ],
)
def test_errors_name_the_value_and_the_limit(
    segment: Segment, error: type[GuardError], value: float, limit: float
) -> None:
    with pytest.raises(error) as caught:
        guard(tilt_deg=45).check(BEGIN, [to(400, 0, 300), segment])
    assert caught.value.value == pytest.approx(value)
    assert caught.value.limit == limit
    assert f"{limit:g}" in str(caught.value)
    assert "segment 2 of 2" in str(caught.value)


def test_a_box_and_a_depth_may_follow_the_plate() -> None:
    held = Guard(
        Limits(low_mm=(-8, -8, -30), high_mm=(8, 8, 4), frame="plate", plate=PLATE, depth_mm=2.5)  # type: ignore[arg-type]
    )
    held.check(BEGIN, [to(452.4, 0, 300), to(450, -7.9, 300)])
    with pytest.raises(WorkspaceError, match="x in the plate frame"):
        held.check(BEGIN, [to(450, -8.1, 300)])
    with pytest.raises(DepthError) as caught:
        held.check(BEGIN, [to(452.6, 0, 300)])
    assert caught.value.value == pytest.approx(2.6)


@pytest.mark.parametrize("joint", [0.0, 4.9, -4.9, 178.0, -180.0])
def test_joint_5_keeps_off_its_singular_positions(joint: float) -> None:
    with pytest.raises(SingularityError):
        guard().check_joints((0, -90, 90, -90, joint, 0))
    guard().check_joints((0, -90, 90, -90, 90, 0))


def test_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(RigError, match="not finite"):
        guard().check(BEGIN, [to(float("nan"), 0, 300)])


def test_limits_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValidationError):
        Limits(low_mm=(0, 0, 0), high_mm=(1, 0, 1))
    with pytest.raises(ValueError, match="need the taught plate"):
        Guard(Limits(**BOX, depth_mm=2.0))
