"""The contact law where the direction turns or reverses, against an event-located integration."""

import math

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.friction import friction_knots
from tests.plugins.simulation.scene.reference import Leg, follow, papilla, rows_of, straight_legs
from tests.plugins.simulation.scene.steps import MU, ideal_skin, places, pressed, rough, run

SWITCHES: dict[str, dict[str, float]] = {
    "none": {},
    "relaxation": {"relaxation_share": 0.2},
    "static": {"static_excess": 0.03},
    "strengthening": {"strengthening": 0.01},
    "no static": {"relaxation_share": 0.2, "strengthening": 0.01},
    "all": {"relaxation_share": 0.2, "static_excess": 0.03, "strengthening": 0.01},
    "much static": {"static_excess": 0.2, "strengthening": 0.01},
}
FLOOR_N = 3e-7
"""Below this errors are those of single events, which fall as it happens."""
JUMP_N = 2e-5
"""The same where static friction exceeds kinetic by so much that a tip is ten million times too
fast for it when it lets go: in that one step its speed is right to a percent."""
MOST_N = {"much static": 1.5e-4}
"""No step, however long, is further off with these switches."""
JUMPS_N = {(1, "much static"): 9.1e-6}
"""Tremors, by tip and switch, that need more than `FLOOR_N`: this one misses by 6.2e-5, 6.8e-6,
1.7e-5 and 9.0e-6 N at 4, 2, 1 and 0.25 ms, where the square of the step leaves 7.8e-6."""


def turn(angle_deg: float, speed: float, first: float = 3.0, second: float = 2.0) -> list[Leg]:
    """Straight on, and then in another direction."""
    a = math.radians(angle_deg)
    end = (first + second * math.cos(a), second * math.sin(a))
    return straight_legs([(0, 0), (first, 0), end], speed)


def tremor(speed: float, seconds: float) -> list[Leg]:
    """100 um at 10 Hz on top of a slide, which reverses at each of its waves."""
    w = 20 * math.pi

    def place(t: float) -> np.ndarray:
        return np.array([speed * t + 0.1 * math.sin(w * t), 0.03 * math.sin(0.7 * w * t)])

    def rate(t: float) -> np.ndarray:
        return np.array([speed + 0.1 * w * math.cos(w * t), 0.021 * w * math.cos(0.7 * w * t)])

    return [Leg(0.0, seconds, place, rate)]


def errors(
    level: int, switch: str, legs: list[Leg], h: float, parts: tuple[int, ...], **scene: float
) -> tuple[list[float], list[int], int]:
    """Largest errors of the force (N), and slips, for steps cut into parts; and the true slips."""
    depth, i, variation = scene.get("depth", 1.2), int(scene.get("tip", 0)), scene.get("rough", 0)
    skin = ideal_skin()
    knots = friction_knots(skin, MU, variation, 0.5, 3)
    springs = rough(skin, variation, 3, level, **SWITCHES[switch])
    begin = pressed(springs, depth)
    at_s, _ = rows_of(legs, depth, h)
    true = follow(papilla(springs, begin, knots, i, depth), legs, at_s)
    misses, slips = [], []
    for count in parts:
        t_s, sensor = rows_of(legs, depth, h, count)
        rows = np.rint(np.concatenate([[0.0], t_s]) * 1e9).astype(np.int64)
        track, load = run(springs, begin.copy(), sensor, t_ns=rows)
        off = load[count - 1 :: count, i, :2] - true.force
        misses.append(float(np.hypot(off[:, 0], off[:, 1]).max()))
        last = track[:, 3 * len(skin) + i]
        slips.append(len(np.unique(last[np.isfinite(last)])))
    return misses, slips, len(true.slips)


def assert_second_order(
    misses: list[float], parts: tuple[int, ...], bound_n: float, switch: str, floor_n: float
) -> None:
    """Stay below a bound that falls as the square of the step."""
    assert misses == [pytest.approx(0.0, abs=max(bound_n / p**2, floor_n)) for p in parts]
    assert max(misses) < MOST_N.get(switch, math.inf)


def floor_of_turns(switch: str) -> float:
    """Error of a turn's force that needs not fall with the step, N."""
    return JUMP_N if switch == "much static" else FLOOR_N


TURNS = {"none": 60, "relaxation": 90, "no static": 90, "static": 110, "much static": 90}
FURTHER = [("no static", 30, 1.0), ("all", 150, 4.0), ("strengthening", 180, 3.0)]


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("switch", "angle_deg", "speed"), [*((*turn, 1.0) for turn in TURNS.items()), *FURTHER]
)
def test_a_turn_is_of_second_order_in_the_step(switch: str, angle_deg: float, speed: float) -> None:
    parts, level = (1, 4, 16), 2 if switch == "none" else 3
    misses, slips, true = errors(level, switch, turn(angle_deg, speed), 8e-3, parts)
    assert slips == [true] * len(parts)
    assert_second_order(misses, parts, 5e-4, switch, floor_of_turns(switch))


@pytest.mark.parametrize("switch", ["none", "all"])
def test_a_tremor_lets_go_as_often_as_it_does_and_is_of_second_order(switch: str) -> None:
    parts = (1, 2, 8)
    misses, slips, true = errors(3, switch, tremor(2.0, 1.2), 4e-3, parts, tip=1, depth=2.0)
    assert true > 3
    assert slips == [true] * len(parts)
    assert_second_order(misses, parts, 8e-4, switch, FLOOR_N)


@pytest.mark.long
@pytest.mark.parametrize(
    ("level", "switch"), [(1, "none"), (2, "none"), *((3, switch) for switch in sorted(SWITCHES))]
)
@pytest.mark.parametrize("angle_deg", [0, 30, 60, 89, 100, 120, 150, 180])
@pytest.mark.parametrize("speed", [0.1, 1.0, 4.0, 10.0])
def test_turns_at_every_level_speed_and_switch(
    level: int, switch: str, angle_deg: float, speed: float
) -> None:
    parts = (1, 2, 4, 16)
    h = {0.1: 32e-3, 1.0: 8e-3, 4.0: 4e-3, 10.0: 2e-3}[speed]
    for longest in {h, 4e-3} if switch == "much static" else {h}:
        misses, slips, true = errors(level, switch, turn(angle_deg, speed), longest, parts)
        assert slips == [true] * len(parts)
        assert_second_order(misses, parts, 2e-3, switch, floor_of_turns(switch))


@pytest.mark.parametrize("speed", [1e3, 1e6, 1e9])
def test_no_speed_is_too_high(speed: float) -> None:
    springs = rough(ideal_skin(), 0.05, 3, **SWITCHES["all"])
    way = np.arange(1, 101)[:, None] * [speed * 2e-3, 0.0, 0.0] + [0.0, 0.0, 2.8]
    track, load = run(springs, pressed(springs), way, h=2e-3)
    assert np.all(np.isfinite(load))
    assert np.all(np.isfinite(places(track)))


@pytest.mark.long
@pytest.mark.parametrize("switch", sorted(SWITCHES))
@pytest.mark.parametrize("tip", [0, 1, 18])
def test_tremors_with_every_switch(switch: str, tip: int) -> None:
    parts = (1, 2, 4, 16)
    misses, slips, true = errors(3, switch, tremor(2.0, 3.0), 4e-3, parts, tip=tip, depth=2.8)
    assert slips == [true] * len(parts)
    assert_second_order(misses, parts, 2e-3, switch, JUMPS_N.get((tip, switch), FLOOR_N))
