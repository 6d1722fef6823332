"""Plate coordinates and the arm's base frame."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sliplab.protocols.program import Position
from sliplab.rigs.core.capabilities import Mounting
from sliplab.rigs.core.plate_frame import PlateFrame

angles = st.floats(-3.0, 3.0)
lengths = st.floats(-50.0, 50.0)


@given(angles, angles, angles, lengths, lengths, st.floats(-5, 5), st.floats(-1, 1))
def test_there_and_back(
    a: float, b: float, c: float, x: float, y: float, depth: float, zero: float
) -> None:
    rotation = Rotation.from_euler("xyz", [a, b, c]).as_matrix()
    centre = np.array([400.0, -20.0, 300.0])
    points = [centre, centre + 30 * rotation[:, 0], centre + 20 * rotation[:, 1] - rotation[:, 0]]
    frame = PlateFrame.taught([p.tolist() for p in points]).with_zero(zero)
    pose = frame.pose(Position(x, y, depth))
    back = frame.position(pose.xyz_mm)
    assert back.distance_mm(Position(x, y, depth)) < 1e-9
    tool = Rotation.from_rotvec(pose.rotvec_deg, degrees=True).as_matrix()
    assert np.allclose(tool, rotation, atol=1e-9)


def test_depth_goes_into_the_plate_from_its_found_zero() -> None:
    frame = PlateFrame.taught([(400, 0, 300), (400, 10, 300), (400, 0, 310)]).with_zero(0.25)
    assert frame.pose(Position(1.0, 2.0, 3.0)).xyz_mm == pytest.approx((403.25, 1.0, 302.0))


@pytest.mark.parametrize(
    ("points", "says"),
    [
        ([(0, 0, 0), (1, 0, 0), (0, 10, 0)], "at least 5 mm"),
        ([(0, 0, 0), (10, 0, 0), (20, 0.1, 0)], "almost on one line"),
        ([(0, 0, 0), (10, 0, 0), (0, 0, 0)], "at least 5 mm"),
    ],
)
def test_points_that_teach_no_plane(points: list[tuple[float, ...]], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PlateFrame.taught(points)


@pytest.mark.parametrize(
    ("mounting", "reading"),
    [
        (Mounting(), (0.1, 0.2, 3.0)),
        (Mounting(feels="arm"), (-0.1, -0.2, -3.0)),
        # the sensor's x is the plate's y
        (Mounting(rotvec_deg=(0.0, 0.0, 90.0)), (0.2, -0.1, 3.0)),
    ],
)
def test_a_reading_becomes_the_force_on_the_plate(mounting: Mounting, reading: Any) -> None:
    frame = PlateFrame.taught([(400, 0, 300), (400, 60, 300), (401, 0, 360)])
    found = np.array(frame.force_matrix(mounting)) @ reading
    assert found == pytest.approx([0.1, 0.2, 3.0])


def test_a_reading_in_the_arms_base_becomes_the_force_on_the_plate() -> None:
    frame = PlateFrame.taught([(400, 0, 300), (400, 60, 300), (401, 0, 360)])
    arm = Mounting(axes="base", feels="arm")
    reaction = -3.0 * frame.axes[2] + 0.5 * frame.axes[0]
    found = np.array(frame.force_matrix(arm)) @ reaction
    assert found == pytest.approx([-0.5, 0.0, 3.0], abs=1e-12)


def test_a_twist_turns_the_tool_about_the_normal_and_leaves_it_where_it_is() -> None:
    frame = PlateFrame.taught([(400.0, 10.0, 300.0), (420.0, 12.0, 300.5), (399.0, 30.0, 301.0)])
    straight = frame.pose(Position(3.0, -2.0, 1.5))
    twisted = frame.pose(Position(3.0, -2.0, 1.5, 30.0))
    assert twisted.xyz_mm == straight.xyz_mm
    before, after = (
        Rotation.from_rotvec(pose.rotvec_deg, degrees=True) for pose in (straight, twisted)
    )
    turn = (after * before.inv()).as_rotvec(degrees=True)
    assert turn == pytest.approx(30.0 * frame.axes[2], abs=1e-9)
    # counterclockwise in the plate's coordinates: from x towards y
    assert frame.axes[1] @ after.apply([1.0, 0.0, 0.0]) == pytest.approx(0.5)
