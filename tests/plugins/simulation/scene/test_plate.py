"""A plate that hangs on friction alone: it must hang still for ever, or fall when it is due."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sliplab.plugins.simulation.scene.springs import SLIPPED, STUCK, Springs, Tips, new_tips
from tests.patching import put
from tests.plugins.simulation.scene.steps import MU, H, fall, ideal_skin, run, slid, times
from tests.plugins.simulation.scene.steps import springs_of as skin_springs

G = 9.81
SKIN = ideal_skin()


def springs_of(level: int = 3, **options: float) -> Springs:
    """Springs of a plate that has been released: with their damping."""
    return skin_springs(SKIN, level, **{"damping_s": 0.01, **options})


def pressed(springs: Springs, depth: float) -> Tips:
    """Tips pressed straight in within 0.3 s."""
    tips, sensor = new_tips(19), np.zeros((300, 3))
    sensor[:, 2] = np.linspace(0, depth, 300)
    run(springs, tips, sensor)
    return tips


def at_the_limit(springs: Springs, depth: float) -> tuple[Tips, float]:
    """Tips that pull up with all the friction they have, and that force, N."""
    tips = pressed(springs, depth)
    limit = MU * tips.normal
    tips.place[:, 1] = tips.base[:, 1] - limit / springs.tangential
    tips.mode[:] = STUCK
    tips.force[:, 1] = limit
    return tips, float(limit.sum())


@pytest.mark.parametrize("excess", [-1e-9, 0.0, 1e-9])
def test_a_balanced_plate_does_not_move(excess: float) -> None:
    springs = springs_of(level=1)
    tips, force = at_the_limit(springs, 2.8)
    motion = np.zeros(2)
    fall(springs, tips, motion, np.full(50, 2.8), force / G * (1 + excess))
    assert abs(motion[1]) < 1e-6  # mm/s


def test_a_plate_one_part_in_a_thousand_too_heavy_slips() -> None:
    springs = springs_of(level=1)
    tips, force = at_the_limit(springs, 2.8)
    motion = np.zeros(2)
    fall(springs, tips, motion, np.full(100, 2.8), force / G * 1.001)
    assert motion[1] == pytest.approx(-1000 * G * 0.001 * 0.1, rel=0.01)
    assert np.all(tips.path > 0.0)


def test_it_hangs_for_a_thousand_seconds_without_drift() -> None:
    springs = springs_of()
    tips, motion = pressed(springs, 3.4), np.zeros(2)
    ramp = np.minimum(np.arange(1, 4001) / 2000, 1.0) * 0.205 * G
    fall(springs, tips, motion, np.full(4000, 3.4), 0.205, weight=ramp)
    before = motion.copy()
    fall(springs, tips, motion, np.full(20_000, 3.4), 0.205, h=0.05)
    assert motion[0] == pytest.approx(before[0], abs=1e-9)
    assert abs(motion[1]) < 1e-12
    assert tips.force[:, 1].sum() == pytest.approx(0.205 * G, rel=1e-9)


def test_tips_that_stick_go_down_with_the_plate() -> None:
    springs = springs_of()
    tips, motion = pressed(springs, 3.4), np.zeros(2)
    place = tips.place.copy()
    ramp = np.minimum(np.arange(1, 3001) / 1500, 1.0) * 0.1 * G
    track, _ = fall(springs, tips, motion, np.full(3000, 3.4), 0.1, weight=ramp)
    assert motion[0] < -0.4
    assert np.all(tips.path == 0.0)
    assert tips.place == pytest.approx(place, abs=1e-12)
    assert np.all(track[:, -1] <= 1e-12)


def test_a_sudden_release_slips_where_a_slow_one_does_not() -> None:
    springs = springs_of()
    way = {}
    for name, ramp_s in (("sudden", 1e-3), ("slow", 2.0)):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        ramp = np.minimum(np.arange(1, 4001) * H / ramp_s, 1.0) * 0.19 * G
        fall(springs, tips, motion, np.full(4000, 3.4), 0.19, weight=ramp)
        way[name] = tips.path.max()
    assert way["slow"] == 0.0
    assert way["sudden"] > 0.0


def test_retraction_slips_outside_first_and_then_the_plate_falls() -> None:
    springs = springs_of(static_excess=0.03)
    tips, motion = pressed(springs, 3.4), np.zeros(2)
    ramp = np.minimum(np.arange(1, 5001) / 2000, 1.0) * 0.205 * G
    fall(springs, tips, motion, np.full(5000, 3.4), 0.205, weight=ramp, stiction=1e-3)
    start = tips.path.copy()
    retract = 3.4 - 0.5 * np.arange(1, 6001) * H
    track, done = fall(springs, tips, motion, retract, 0.205, stiction=1e-3)
    assert done < 6000
    assert motion.tolist() == [-25.0, 0.0]
    way = slid(track) - start
    first = np.argmax(way > 1e-6, axis=0) * H
    moved = np.argmax(way > 0.167, axis=0) * H
    assert first[SKIN.ring == 2].max() <= first[0]
    assert 0.7 < first[0] - first.min() < 1.6
    assert done * H - moved[0] < 0.35


def test_stiction_carries_what_it_can() -> None:
    springs = springs_of()
    tips, motion = new_tips(19), np.zeros(2)
    clear = np.full(100, -1.0)
    fall(springs, tips, motion, clear, 0.001, stiction=0.01)
    assert motion.tolist() == [0.0, 0.0]
    fall(springs, tips, motion, clear[:50], 0.002, stiction=0.01)
    expected = -(0.002 * G - 0.01) / 0.002 * 1000 * 0.05
    assert motion[1] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("steps", [7, 100])
def test_free_fall_is_exact_at_any_step(steps: int) -> None:
    springs, motion = springs_of(), np.zeros(2)
    fall(springs, new_tips(19), motion, np.full(steps, -1.0), 0.2, h=0.07 / steps)
    assert motion == pytest.approx([-0.5 * G * 1000 * 0.07**2, -G * 1000 * 0.07], rel=1e-12)


def test_the_stop_is_met_when_it_is_met() -> None:
    springs, motion, rows = springs_of(), np.zeros(2), times(100, H)
    _, done = fall(springs, new_tips(19), motion, np.full(100, -1.0), 0.2, t_ns=rows)
    due_s = math.sqrt(2 * 25e-3 / G)
    assert done == math.ceil(due_s / H)
    assert rows[done] == pytest.approx(due_s * 1e9, abs=2)
    assert motion.tolist() == [-25.0, 0.0]


def test_a_light_plate_does_not_ring() -> None:
    # its own period is far shorter than a step; it hangs where its weight says
    springs = springs_of(level=1, damping_s=0.0)
    tips, motion = pressed(springs, 3.4), np.zeros(2)
    track, _ = fall(springs, tips, motion, np.full(40, 3.4), 1e-6)
    assert np.ptp(track[-10:, -1]) < 1e-12
    assert motion[0] == pytest.approx(-1e-6 * G / springs.tangential.sum(), rel=1e-6)


def test_stuck_tips_and_the_plate_are_a_damped_oscillator_at_second_order() -> None:
    springs = springs_of(level=1)
    mass, k = 0.1, float(springs.tangential.sum())
    errors = []
    for steps in (200, 400, 800):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        fall(springs, tips, motion, np.full(steps, 3.4), mass, h=0.1 / steps)
        assert np.all(tips.path == 0.0)
        # m x" = -k x - k d x' - m g, closed form of the underdamped step
        omega2, gamma = 1e3 * k / mass, 0.5 * 1e3 * k * 0.01 / mass
        omega = math.sqrt(omega2 - gamma**2)
        sag = 1e3 * G / omega2
        decay = math.exp(-gamma * 0.1)
        exact = -sag * (1 - decay * (math.cos(omega * 0.1) + gamma / omega * math.sin(omega * 0.1)))
        errors.append(abs(motion[0] - exact))
    orders = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    assert orders == pytest.approx([2.0, 2.0], abs=0.05)


Flow = Callable[[float, np.ndarray], Any]


class Hanging:
    """Rings of tips under a plate that is let down and then loses its hold, in continuous time."""

    mass, depth, ramp_s, still_s, retract = 0.165, 3.4, 0.3, 0.2, 3.0
    damping_s = 0.01
    states = 5
    """Height and speed of the plate, and each ring's stretch."""

    def __init__(self, springs: Springs) -> None:
        which = [int(np.flatnonzero(SKIN.ring == ring)[0]) for ring in (0, 1, 2)]
        self.counts = np.bincount(SKIN.ring)
        self.k, self.k_n = springs.tangential[which], springs.normal[which]
        self.gap = springs.gap[which]

    def normal(self, t: float) -> np.ndarray:
        depth = self.depth - self.retract * max(t - self.ramp_s - self.still_s, 0.0)
        return self.k_n * np.maximum(depth - self.gap, 0.0)

    def force(self, t: float, y: np.ndarray, slips: np.ndarray) -> np.ndarray:
        stuck = self.k * y[2:] - self.k * self.damping_s * y[1]
        return np.where(slips, MU * self.normal(t), stuck)

    def part(self, t: float, y: np.ndarray, slips: np.ndarray):
        """Integrate until another ring lets go or the plate lands."""

        def flow(t: float, y: np.ndarray) -> np.ndarray:
            pull = float(self.counts @ self.force(t, y, slips))
            weight = self.mass * G * min(t / self.ramp_s, 1.0)
            free = (MU * self.normal(t) - self.k * y[2:]) / (self.k * self.damping_s)
            stretch = np.where(slips, free, -y[1])
            return np.array([y[1], (pull - weight) / self.mass * 1e3, *stretch])

        def lets_go(ring: int) -> Callable[[float, np.ndarray], float]:
            def ends(t: float, y: np.ndarray) -> float:
                if slips[ring]:
                    return -1.0
                return float((self.force(t, y, slips) - MU * self.normal(t))[ring])

            put(ends, "terminal", True)
            return ends

        return self.solve(flow, [lets_go(ring) for ring in range(3)], t, y)

    def solve(self, flow: Flow, changes: list[Flow], t: float, y: np.ndarray, **how: float):
        """Integrate until a ring changes or the plate has fallen 25 mm, or to the next corner."""

        def lands(_: float, y: np.ndarray) -> float:
            return float(y[0]) + 25.0

        put(lands, "terminal", True)
        # the rates have corners where the weight is whole and where the retraction begins
        corners = [c for c in (self.ramp_s, self.ramp_s + self.still_s, 10.0) if c > t + 1e-12]
        how = {"rtol": 1e-10, "atol": 1e-11} | how
        return solve_ivp(flow, (t, corners[0]), y, method="DOP853", events=[*changes, lands], **how)

    def onsets(self) -> tuple[list[float], float]:
        """When each ring first lets go, and when the plate has fallen 25 mm, s."""
        t, y, slips, found = 0.0, np.zeros(self.states), np.zeros(3, bool), [math.nan] * 3
        while True:
            part = self.part(t, y, slips)
            t, y = float(part.t[-1]), part.y[:, -1]
            if len(part.t_events[3]):
                return found, t
            for ring in range(3):
                if len(part.t_events[ring]):
                    found[ring] = t if math.isnan(found[ring]) else found[ring]
                    slips = slips ^ (np.arange(3) == ring)


def test_rings_let_go_and_the_plate_lands_when_an_integration_says_at_second_order() -> None:
    springs = springs_of(level=1)
    true = Hanging(springs)
    onsets, lands = true.onsets()
    misses = []
    for h in (2e-3, 1e-3, 0.5e-3):
        tips, motion, steps = pressed(springs, true.depth), np.zeros(2), round(2.0 / h)
        rows, t = times(steps, h), np.arange(1, steps + 1) * h
        depth = true.depth - true.retract * np.maximum(t - true.ramp_s - true.still_s, 0.0)
        weight = np.minimum(t / true.ramp_s, 1.0) * true.mass * G
        tips.state[:, SLIPPED] = np.nan
        track, done = fall(springs, tips, motion, depth, true.mass, weight=weight, h=h, t_ns=rows)
        assert motion.tolist() == [-25.0, 0.0]
        first = [
            track[np.argmax(slid(track)[:, i] > 0.0), 57 + i]
            for i in (np.flatnonzero(SKIN.ring == ring)[0] for ring in (0, 1, 2))
        ]
        misses.append(np.abs([*(np.array(first) - onsets), rows[done] * 1e-9 - lands]))
    # 1 ms steps: the centre's onset and the landing to microseconds
    assert np.all(misses[1] < 2e-5)
    assert np.all(misses[2] < misses[0] / 8 + 1e-8)


@pytest.mark.parametrize("level", [1, 3])
def test_a_disturbance_brings_slip_forward_and_125_per_cent_is_no_exception(level: int) -> None:
    springs = springs_of(level, static_excess=0.03, relaxation_share=0.2)
    onsets, sides = [], []
    for share in (0.0, 0.25, 0.5, 0.75, 1.0, 1.25, -1.25):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        ramp = np.minimum(np.arange(1, 5001) / 2000, 1.0) * 0.165 * G
        fall(springs, tips, motion, np.full(5000, 3.4), 0.165, weight=ramp, stiction=1e-3)
        start, here = tips.path.copy(), float(motion[0])
        assert here > -10.0  # it hangs
        t = np.arange(1, 6001) * H
        sensor = np.column_stack([0.5 * share * t, np.zeros(6000), 3.4 - 0.5 * t])
        track, _ = fall(springs, tips, motion, sensor, 0.165, stiction=1e-3)
        assert np.all(np.isfinite(track[:, :57]))
        assert motion[0] == -25.0
        way = slid(track) - start
        first = np.argmax(way > 1e-3, axis=0) * H
        onsets.append(first.min())
        sides.append(track[:, :38].reshape(-1, 19, 2)[:, 0, 0])
        # whatever comes from the side, the centre is not the first to slip
        assert first[0] > first.min()
    assert np.all(np.diff(onsets[:6]) <= 1e-9)
    assert onsets[5] < 0.92 * onsets[0]
    # leftward is the mirror image of rightward
    assert onsets[6] == pytest.approx(onsets[5], abs=1e-9)
    length = min(len(sides[5]), len(sides[6]))
    assert sides[6][:length] == pytest.approx(-sides[5][:length], abs=1e-6)


def test_chunks_do_not_matter() -> None:
    springs = springs_of(static_excess=0.03, relaxation_share=0.2)
    depth = 3.4 - 0.5 * np.arange(1, 1001) * H
    results = []
    for size in (1000, 1):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        for k in range(0, 1000, size):
            _, done = fall(springs, tips, motion, depth[k : k + size], 0.165)
            assert done == size
        results.append((motion.copy(), np.delete(tips.state, SLIPPED, axis=1)))
    (first, tips), (second, others) = results
    assert np.array_equal(first, second)
    assert np.array_equal(tips, others)
