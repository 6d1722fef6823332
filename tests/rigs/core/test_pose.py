"""Poses in each arm's language against closed forms, and there and back."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.rigs.core.capabilities import Pose
from sliplab.rigs.core.pose import (
    angle_deg,
    between,
    distance_mm,
    from_quaternion,
    from_ur,
    quaternion,
    short_rotvec_deg,
    to_ur,
)
from tests.patching import loose

COORDINATE = st.floats(-2000, 2000)
TURN = st.floats(-100, 100)
POSES = st.builds(Pose, st.tuples(COORDINATE, COORDINATE, COORDINATE), st.tuples(TURN, TURN, TURN))


def test_ur_speaks_metres_and_radians() -> None:
    assert to_ur(Pose((400.0, -15.0, 0.6), (180.0, 0.0, -90.0))) == pytest.approx(
        [0.4, -0.015, 0.0006, math.pi, 0.0, -math.pi / 2]
    )


@pytest.mark.parametrize(
    ("axis", "angle"), [((1, 0, 0), 180.0), ((0, 1, 0), 90.0), ((0, 0, 1), 30.0), ((0, 0, 1), 0.0)]
)
def test_a_turn_about_an_axis_is_half_its_angle_in_a_quaternion(axis: Any, angle: float) -> None:
    half = math.radians(angle) / 2
    want = [math.cos(half), *(math.sin(half) * a for a in axis)]
    rotvec = tuple(angle * a for a in axis)
    got = quaternion(Pose((0, 0, 0), loose(rotvec)))
    assert got == pytest.approx(want, abs=1e-12)


def test_a_quaternions_sign_and_length_do_not_matter() -> None:
    one = from_quaternion((1, 2, 3), (0.5, 0.5, 0.5, 0.5))
    assert one.rotvec_deg == pytest.approx([120 / math.sqrt(3)] * 3)
    other = from_quaternion((1, 2, 3), (-2, -2, -2, -2))
    assert other.rotvec_deg == pytest.approx(one.rotvec_deg)


@given(POSES)
def test_poses_survive_both_ways(pose: Pose) -> None:
    for back in (from_ur(to_ur(pose)), from_quaternion(pose.xyz_mm, quaternion(pose))):
        assert distance_mm(back, pose) < 1e-9
        assert angle_deg(back, pose) < 1e-5


def test_long_rotation_vectors_become_short() -> None:
    short = short_rotvec_deg(np.array([[270.0, 0, 0], [0, 10, 0]]))
    assert short == pytest.approx(np.array([[-90.0, 0, 0], [0, 10, 0]]))
    assert short_rotvec_deg(np.empty((0, 3))).shape == (0, 3)


def test_half_way_is_half_the_line_and_half_the_turn() -> None:
    half = between(Pose((0, 0, 0), (0, 0, 0)), Pose((10, 0, -4), (0, 0, 90)), 0.5)
    assert half.xyz_mm == (5, 0, -2)
    assert half.rotvec_deg == pytest.approx((0, 0, 45))


def test_an_angle_does_not_depend_on_the_place() -> None:
    here = Pose((1.0, 2.0, 3.0), (0.0, 0.0, 10.0))
    assert angle_deg(here, Pose(here.xyz_mm, (0.0, 0.0, 40.0))) == pytest.approx(30.0)
    assert angle_deg(here, Pose((9.0, 9.0, 9.0), here.rotvec_deg)) == 0.0


def test_of_two_quaternions_the_one_with_positive_w_is_told() -> None:
    half = math.sqrt(0.5)
    found = quaternion(Pose((0.0, 0.0, 0.0), (0.0, 0.0, 270.0)))
    assert found == pytest.approx((half, 0.0, 0.0, -half))
