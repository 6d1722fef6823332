"""The lens against a pinhole written out in three dimensions, and its scale against differences."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sliplab.rigs.scene.lens import Lens

PLACES = np.random.default_rng(3).uniform(-20.8, 20.8, (50, 2))
TILT = st.floats(-20.0, 20.0)


def pinhole(place: np.ndarray, tilt: tuple[float, float], k1: float, away: float) -> np.ndarray:
    """One place after another: turn about x, then y; divide by depth; Brown's radial term."""
    turn = Rotation.from_euler("xy", tilt, degrees=True)
    result = []
    for x, y in place:
        px, py, pz = turn.apply([x, y, 0.0])
        u, v = px / (away + pz), py / (away + pz)
        bent = 1.0 + k1 * (u * u + v * v)
        result.append([415.5 + 20.0 * away * u * bent, 415.5 - 20.0 * away * v * bent])
    return np.array(result)


@given(tilt=st.tuples(TILT, TILT), k1=st.floats(-0.5, 0.5), away=st.floats(100.0, 2000.0))
def test_it_is_a_pinhole(tilt: tuple[float, float], k1: float, away: float) -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=tilt, k1=k1, distance_mm=away)
    assert lens.project(PLACES) == pytest.approx(pinhole(PLACES, tilt, k1, away), abs=1e-8)


def test_without_a_radial_term_it_is_its_homography() -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=(5.0, -4.0))
    far = np.concatenate([PLACES, np.ones((50, 1))], axis=1) @ lens.homography.T
    assert lens.project(PLACES) == pytest.approx(far[:, :2] / far[:, 2:], abs=1e-9)


def test_straight_on_it_is_one_scale() -> None:
    lens = Lens(20.0, 832, 640)
    assert lens.straight
    assert lens.project(np.array([0.0, 0.0])).tolist() == [415.5, 319.5]
    assert lens.project(np.array([1.0, 2.0])).tolist() == [435.5, 279.5]
    assert lens.scale(PLACES).tolist() == [20.0] * 50


@pytest.mark.parametrize("tilt", [(0.0, 0.0), (5.0, -4.0), (-15.0, 10.0)])
@pytest.mark.parametrize("k1", [0.0, -0.4, 0.7])
def test_the_local_scale_is_the_root_of_the_area_that_a_small_square_covers(
    tilt: tuple[float, float], k1: float
) -> None:
    lens = Lens(20.0, 832, 832, tilt_deg=tilt, k1=k1)
    step = 1e-4
    right, up = np.array([step, 0.0]), np.array([0.0, step])
    a = (lens.project(PLACES + right) - lens.project(PLACES - right)) / (2 * step)
    b = (lens.project(PLACES + up) - lens.project(PLACES - up)) / (2 * step)
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    assert lens.scale(PLACES) == pytest.approx(np.sqrt(area), rel=1e-7)
