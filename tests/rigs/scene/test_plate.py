"""A plate that hangs on friction alone: it must hang still for ever, or fall when it is due."""

import math

import numpy as np
import pytest

from rigs.scene.springs import SLIPPED, STUCK, Springs, Tips, new_tips
from tests.rigs.scene.steps import MU, H, fall, ideal_skin, run, slid
from tests.rigs.scene.steps import springs_of as skin_springs

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


def test_free_fall_is_of_first_order_in_the_step() -> None:
    springs = springs_of()
    errors = []
    for steps in (50, 100, 200):
        motion = np.zeros(2)
        fall(springs, new_tips(19), motion, np.full(steps, -1.0), 0.2, h=0.05 / steps)
        errors.append(abs(motion[0] + 0.5 * G * 1000 * 0.05**2))
    assert errors[0] / errors[1] == pytest.approx(2.0, rel=0.05)
    assert errors[1] / errors[2] == pytest.approx(2.0, rel=0.05)


def test_stuck_tips_and_the_plate_are_a_damped_oscillator_at_first_order() -> None:
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
    assert orders == pytest.approx([1.0, 1.0], abs=0.15)


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
