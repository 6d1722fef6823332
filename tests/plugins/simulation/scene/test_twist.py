"""A sensor that turns about the plate's normal drags its tips on arcs."""

import math

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.springs import SLIDING, STUCK, new_tips
from tests.plugins.simulation.scene.steps import (
    MU,
    ideal_skin,
    line,
    pressed,
    run,
    slid,
    springs_of,
)


def angles(end_deg: float, steps: int, start_deg: float = 0.0, depth: float = 2.8) -> np.ndarray:
    """A turn on the spot, its first row left out."""
    sensor = np.zeros((steps, 6))
    sensor[:, 2] = depth
    share = np.arange(1, steps + 1) / steps
    sensor[:, 5] = np.radians(start_deg + share * (end_deg - start_deg))
    return sensor


def radii() -> np.ndarray:
    return np.hypot(*np.array(ideal_skin().layout_mm).T)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_an_angle_of_zero_is_no_angle_to_the_bit(level: int) -> None:
    springs = springs_of(ideal_skin(), level, static_excess=0.03, strengthening=0.01)
    plain, turned = pressed(springs), pressed(springs)
    path = line((0, 0, 2.8), (9, -4, 2.6), 700)
    six = np.zeros((len(path), 6))
    six[:, :3] = path
    expected = run(springs, plain, path)
    for found, known in zip(run(springs, turned, six), expected, strict=True):
        assert np.array_equal(found, known, equal_nan=True)
    assert np.array_equal(plain.state, turned.state, equal_nan=True)


@pytest.mark.parametrize("way", [1, -1])
def test_a_tip_sticks_until_its_chord_is_mu_n_over_k(way: int) -> None:
    """Closed form: the base moves on a circle, and the spring is the chord from where it began."""
    skin = ideal_skin()
    springs, r = springs_of(skin, level=1), radii()
    tips = pressed(springs)
    limit = MU * tips.normal / skin.tangential_n_per_mm
    steps = 4000
    track, load = run(springs, tips, angles(40.0 * way, steps))
    off = r > 0
    slips_at = 2.0 * np.degrees(np.arcsin(limit[off] / (2.0 * r[off])))
    assert slips_at.max() < 40.0
    assert tips.slipped_s[off] == pytest.approx(slips_at / 40.0 * steps * 1e-3, rel=1e-6)
    assert np.all(tips.mode[off] == SLIDING)
    # the centre turns on the spot
    assert tips.mode[~off] == STUCK
    assert np.abs(track[:, :2][:, : 2 * int((~off).sum())]).max() == 0.0
    assert np.abs(load[-1, :, :2].sum(axis=0)).max() < 1e-9  # no net force


def test_a_tip_that_slides_on_follows_a_smaller_circle() -> None:
    """In steady sliding force and way are along one line: the tip's radius is sqrt(r^2 - s^2)."""
    skin = ideal_skin()
    springs, r = springs_of(skin, level=1), radii()
    tips = pressed(springs)
    spring = MU * tips.normal / skin.tangential_n_per_mm
    n = len(r)
    track, _ = run(springs, tips, angles(170.0, 8000))
    there = np.hypot(*track[-1, : 2 * n].reshape(n, 2).T)
    outer = r > 6.0
    expected = np.sqrt(r[outer] ** 2 - spring[outer] ** 2)
    assert there[outer] == pytest.approx(expected, rel=2e-3)


def test_a_way_slid_is_the_arc_and_no_chord() -> None:
    """Twice as many steps give the same way: steps of a degree are fine enough."""
    found = []
    for steps in (90, 180, 1440):
        springs = springs_of(ideal_skin(), level=1)
        tips = pressed(springs)
        found.append(slid(run(springs, tips, angles(90.0, steps))[0])[-1])
    assert found[0] == pytest.approx(found[2], rel=3e-3, abs=1e-3)
    assert np.abs(found[1] - found[2]).max() < np.abs(found[0] - found[2]).max() + 1e-9


@pytest.mark.parametrize("level", [1, 3])
def test_a_skin_that_stands_turned_slides_as_the_turned_world_does(level: int) -> None:
    """Pressed at 90 degrees and slid along x: the straight trial slid along -y, turned by 90."""
    springs = springs_of(ideal_skin(), level)
    n = len(springs.gap)
    straight = pressed(springs)
    known, _ = run(springs, straight, line((0, 0, 2.8), (0, -9, 2.8), 900))
    turned = new_tips(n)
    press = np.zeros((200, 6))
    press[:, 2] = np.linspace(2.8 / 200, 2.8, 200)
    press[:, 5] = math.pi / 2
    run(springs, turned, press)
    slide = np.zeros((900, 6))
    slide[:, 0], slide[:, 2], slide[:, 5] = np.arange(1, 901) / 100, 2.8, math.pi / 2
    found, _ = run(springs, turned, slide)
    x, y = known[:, 0 : 2 * n : 2], known[:, 1 : 2 * n : 2]
    assert found[:, 0 : 2 * n : 2] == pytest.approx(-y, abs=1e-9)
    assert found[:, 1 : 2 * n : 2] == pytest.approx(x, abs=1e-9)
