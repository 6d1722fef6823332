"""The tool's tip from pivoting: closed form, noise, and sets that tell nothing."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from sliplab.analysis.calibration.pivot import PivotError, find_tip

Floats = NDArray[np.float64]
lengths = st.floats(-300.0, 300.0)
points = st.tuples(lengths, lengths, lengths).map(np.array)


def leaning(lean_deg: float, count: int, about: Rotation, twist_deg: float = 10.0) -> Rotation:
    """`count` orientations round a cone, each also turned about its own axis."""
    ways = np.radians(360.0 * np.arange(count) / count)
    lean = np.radians(lean_deg) * np.column_stack([np.cos(ways), np.sin(ways), 0 * ways])
    twist = np.radians(twist_deg) * np.column_stack([0 * ways, 0 * ways, np.sin(3 * ways)])
    return about * Rotation.from_rotvec(lean) * Rotation.from_rotvec(twist)


def poses(turns: Rotation, tip: Floats, point: Floats) -> tuple[Floats, Floats]:
    return point - turns.apply(tip), np.degrees(turns.as_rotvec())


@given(points, points, st.floats(15.0, 60.0), st.integers(4, 12), st.integers(0, 2**32 - 1))
def test_without_noise_the_tip_is_exact(
    tip: Floats, point: Floats, lean: float, count: int, seed: int
) -> None:
    about = Rotation.random(rng=np.random.default_rng(seed))
    found = find_tip(*poses(leaning(lean, count, about), tip, point))
    assert np.allclose(found.tip_mm, tip, atol=1e-8)
    assert np.allclose(found.point_mm, point, atol=1e-8)
    assert found.residual_mm < 1e-8


@given(points, points, st.integers(0, 2**32 - 1), st.floats(0.01, 0.5), st.integers(6, 20))
def test_noise_moves_the_tip_no_more_than_is_said(
    tip: Floats, point: Floats, seed: int, noise: float, count: int
) -> None:
    rng = np.random.default_rng(seed)
    turns = leaning(25.0, count, Rotation.random(rng=rng))
    xyz, rotvec = poses(turns, tip, point)
    found = find_tip(xyz + noise * rng.standard_normal(xyz.shape), rotvec)
    truly = noise / (found.spread * np.sqrt(count))
    # worst known direction: five deviations of it hold any direction
    assert np.linalg.norm(found.tip_mm - tip) < 6.0 * truly
    assert found.residual_mm < 2.0 * noise * 3**0.5
    assert found.errors_mm.shape == (count,)


@given(points, points, points, st.floats(-3.0, 3.0))
def test_where_the_base_stands_changes_nothing(
    tip: Floats, point: Floats, moved: Floats, angle: float
) -> None:
    rng = np.random.default_rng(1)
    turns = leaning(30.0, 6, Rotation.identity())
    xyz, rotvec = poses(turns, tip, point)
    xyz = xyz + 0.1 * rng.standard_normal(xyz.shape)
    base = Rotation.from_euler("zyx", [angle, 0.3, -0.2])
    one = find_tip(xyz, rotvec)
    other = find_tip(base.apply(xyz) + moved, np.degrees((base * turns).as_rotvec()))
    assert np.allclose(one.tip_mm, other.tip_mm, atol=1e-6)
    assert one.residual_mm == pytest.approx(other.residual_mm, abs=1e-6)


@given(st.integers(4, 12), points, st.floats(0.1, 3.0))
def test_turning_about_one_axis_is_refused(count: int, tip: Floats, most: float) -> None:
    assume(np.linalg.norm(tip) > 1.0)
    axis = np.array([0.3, -0.5, 0.8]) / np.linalg.norm([0.3, -0.5, 0.8])
    turns = Rotation.from_rotvec(np.linspace(0.0, most, count)[:, None] * axis)
    with pytest.raises(PivotError, match="too much alike"):
        find_tip(*poses(turns, tip, np.zeros(3)))


def test_what_is_no_set_of_poses_is_refused() -> None:
    xyz, rotvec = poses(leaning(30.0, 6, Rotation.identity()), np.ones(3), np.zeros(3))
    with pytest.raises(PivotError, match="at least 4"):
        find_tip(xyz[:3], rotvec[:3])
    with pytest.raises(PivotError, match="too much alike"):  # nobody moved the arm
        find_tip(xyz[[0] * 6], rotvec[[0] * 6])
    with pytest.raises(PivotError, match="too much alike"):  # a hair's breadth
        find_tip(*poses(leaning(3.0, 8, Rotation.identity()), np.ones(3), np.zeros(3)))
    xyz[2, 1] = np.nan
    with pytest.raises(PivotError, match="number that is none"):
        find_tip(xyz, rotvec)
    with pytest.raises(PivotError, match="shapes"):
        find_tip(xyz[:, :2], rotvec)


def test_one_pose_off_the_point_is_named() -> None:
    xyz, rotvec = poses(leaning(30.0, 10, Rotation.identity()), np.array([1.0, 2, 90]), np.zeros(3))
    xyz[6] += [0.0, 3.0, 0.0]
    assert find_tip(xyz, rotvec).errors_mm.argmax() == 6
