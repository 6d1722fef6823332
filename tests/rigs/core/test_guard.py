"""Every limit stops a move before anything is sent, and says what it held against what."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from sliplab.protocols.program import Position
from sliplab.rigs.core.arm_settings import ArmLimits
from sliplab.rigs.core.capabilities import Pose, RigError, Segment
from sliplab.rigs.core.guard import (
    MEASURED_MM,
    DepthError,
    Guard,
    GuardError,
    PlateLimits,
    SingularityError,
    SpeedError,
    TiltError,
    WorkspaceError,
)
from sliplab.rigs.core.plate_frame import PlateFrame

DOWN = (180.0, 0.0, 0.0)
BEGIN = Pose((400.0, 0.0, 300.0), DOWN)
BOX: dict[str, Any] = {"low_mm": (300, -50, 200), "high_mm": (500, 50, 400)}
# a plate whose x is the base's y, whose y is up, and into which the base's x points
PLATE = {"centre_mm": (450, 0, 300), "right_mm": (450, 20, 300), "above_mm": (450, 0, 320)}


def guard(**more: Any) -> Guard:
    return Guard(ArmLimits(**{**BOX, **more}))


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
        ArmLimits(low_mm=(-8, -8, -30), high_mm=(8, 8, 4), frame="plate", plate=PLATE, depth_mm=2.5)  # type: ignore[arg-type]
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


FRAME = PlateFrame.taught((PLATE["centre_mm"], PLATE["right_mm"], PLATE["above_mm"]))


def at(x: float, y: float, depth: float) -> Pose:
    return FRAME.pose(Position(x, y, depth))


def test_limits_of_the_rig_count_in_the_frame_it_uses() -> None:
    held = Guard(None, PlateLimits(depth_mm=3.0, reach_mm=10.0, speed_mm_s=20.0, rim_mm=10.0))
    held.check_segment(at(0, 0, -5), Segment(at(8, 6, 3.0), 20.0), FRAME)
    for frame, closed_mm in ((FRAME.with_zero(-0.5), 0.0), (FRAME, 0.5)):
        with pytest.raises(DepthError, match=r"depth in contact 3\.5 mm is beyond its limit 3 mm"):
            held.check_segment(at(0, 0, -5), Segment(at(0, 0, 3.0), 20.0), frame, closed_mm)
    with pytest.raises(WorkspaceError, match=r"distance from the plate's centre 10\.3"):
        held.check_segment(at(0, 0, -5), Segment(at(8, 6.5, 0), 20.0), FRAME)
    with pytest.raises(SpeedError, match=r"rim at 120 deg/s: 20\.94 mm/s"):
        held.check_segment(at(0, 0, -5), Segment(at(0, 0, -5), 10.0, turn_deg_s=120.0), FRAME)
    assert held.speed_mm_s == 20.0


def test_a_move_may_not_turn_the_tool_faster_than_a_turn_on_the_spot() -> None:
    """A controller turns the tool while it moves: at once, if the way is short."""
    held = Guard(None, PlateLimits(3.0, 10.0, speed_mm_s=20.0, rim_mm=10.0))

    def turns(angle: float, way_mm: float) -> Segment:
        return Segment(FRAME.pose(Position(0, 0, -5 - way_mm, twist_deg=angle)), 10.0)

    begin = at(0, 0, -5)
    held.check_segment(begin, turns(28.0, 2.5), FRAME)  # 112 of 114.6 deg/s
    held.check_segment(begin, turns(0.9, 0.0), FRAME)  # as poses scatter
    with pytest.raises(
        SpeedError, match=r"turn by 28 deg .* 2\.4 mm: 116\.7 deg/s .* 114\.6 deg/s"
    ):
        held.check_segment(begin, turns(28.0, 2.4), FRAME)
    for angle, way_mm in ((28.0, 0.0), (1.5, 0.01)):
        with pytest.raises(SpeedError, match="speed of the turn"):
            held.check_segment(begin, turns(angle, way_mm), FRAME)
    Guard(ArmLimits(**BOX)).check_segment(begin, turns(28.0, 0.1), FRAME)  # of an unknown rim


def test_path_straight_out_may_end_no_farther_outside() -> None:
    held = Guard(None, PlateLimits(3.0, 10.0, 20.0))
    begin = at(14, 0, 4)
    held.check_segment(begin, Segment(at(14, 0, -5), 5.0), FRAME)
    held.check_segment(begin, Segment(at(0, 0, -5), 5.0), FRAME)
    for end in (at(14.1, 0, -5), at(0, 0, 4.1)):
        with pytest.raises(GuardError):
            held.check_segment(begin, Segment(end, 5.0), FRAME)


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        ((30, 0, -5), (-29, 0, -5)),  # over the whole plate
        ((30, 0, -5), (0, 29, -5)),
        ((30, 0, -5), (29, 0, -5)),
        ((0, 0, 6), (9, 0, 5.9)),  # sideways, too deep
        ((14, 0, 1), (14, 0, 2)),
        ((0, 0, -35), (0, 0, 8)),  # from before the box through the plate
        ((0, 0, 8), (0, 0, -31)),
    ],
)
def test_path_from_outside_leads_inside_or_straight_out(begin: Any, end: Any) -> None:
    box = ArmLimits(
        low_mm=(-40, -40, -30),
        high_mm=(40, 40, 7),
        frame="plate",
        plate=PLATE,  # type: ignore[arg-type]
    )
    held = Guard(box, PlateLimits(5.0, 10.0, 20.0))
    with pytest.raises(GuardError):
        held.check_segment(at(*begin), Segment(at(*end), 5.0), FRAME)
    x, y, depth = begin
    if depth > -30:
        held.check_segment(at(x, y, depth), Segment(at(x + 0.02, y, depth - 1.5), 5.0), FRAME)
    held.check_segment(at(x, y, depth), Segment(at(0, 0, -5), 5.0), FRAME)


def test_way_out_at_a_place_outside_passes_the_drivers_check_too() -> None:
    """A driver does not know the rig's plate, and must not hold an arm in it."""
    outside = Pose((400.0, 50.3, 300.0), DOWN)
    guard().check(outside, [to(380, 50.31, 300)])
    for end in (to(380, 50.4, 300), to(380, -50.2, 300), to(299.9, 50.3, 300)):
        with pytest.raises(WorkspaceError):
            guard().check(outside, [end])


def test_measured_pose_on_the_other_side_is_outside() -> None:
    held = Guard(ArmLimits(**BOX), PlateLimits(3.0, 10.0, 20.0))
    held.check_measured(at(14, 0, 0), at(14, 0, 0), FRAME)
    for pose, begin in (
        (at(-14, 0, 0), at(14, 0, 0)),
        (Pose((450.0, 0.0, 195.0), DOWN), Pose((450.0, 0.0, 405.0), DOWN)),
    ):
        with pytest.raises(WorkspaceError, match="stopped on its way"):
            held.check_measured(pose, begin, FRAME)


def test_measured_poses_may_scatter_about_a_limit() -> None:
    held = Guard(ArmLimits(**BOX), PlateLimits(3.0, 10.0, 20.0))
    inside, outside = at(0, 0, 0), at(0, 0, 4)
    held.check_measured(at(0, 0, 3 + 0.9 * MEASURED_MM), inside, FRAME)
    held.check_measured(at(0, 0, 4 + 0.9 * MEASURED_MM), outside, FRAME)
    for pose, begin in ((at(0, 0, 3 + 1.1 * MEASURED_MM), inside), (at(0, 0, 4.3), outside)):
        with pytest.raises(DepthError, match="stopped on its way"):
            held.check_measured(pose, begin, FRAME)
    with pytest.raises(WorkspaceError, match="z in the base frame"):
        held.check_measured(Pose((450.0, 0.0, 400.3), DOWN), Pose((450.0, 0.0, 300.0), DOWN), FRAME)


def test_numbers_that_are_none_are_refused() -> None:
    with pytest.raises(RigError, match="not finite"):
        guard().check(BEGIN, [to(float("nan"), 0, 300)])


def test_limits_that_make_no_sense_are_refused() -> None:
    with pytest.raises(ValidationError):
        ArmLimits(low_mm=(0, 0, 0), high_mm=(1, 0, 1))
    with pytest.raises(ValueError, match="need the taught plate"):
        Guard(ArmLimits(**BOX, depth_mm=2.0))
