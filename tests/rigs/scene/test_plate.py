"""A plate that hangs on friction alone: it must hang still for ever, or fall when it is due."""

import numpy as np
import pytest

from rigs.scene.contact import (
    STUCK,
    Springs,
    Tips,
    advance,
    friction_field,
    make_springs,
    new_scratch,
    new_tips,
    track_width,
)
from rigs.scene.plate import advance_free
from rigs.scene.skin import SkinGeometry, make_skin

H, G, MU = 1e-3, 9.81, 0.85
SKIN = make_skin(SkinGeometry(), 1)


def springs_of(mu: float = MU, **options: float) -> Springs:
    return make_springs(
        SKIN, friction=friction_field(SKIN, mu, 0.0, 0.5, 1), **{"damping_s": 0.01, **options}
    )


def pressed(springs: Springs, depth: float) -> Tips:
    tips, steps = new_tips(19), 300
    sensor = np.zeros((steps, 5))
    sensor[:, 2] = np.linspace(0, depth, steps)
    track, load = np.zeros((steps, track_width(19))), np.zeros((steps, 0))
    advance(springs, tips, new_scratch(19), H, sensor, np.zeros(steps + 1), track, load)
    return tips


def fall(
    springs: Springs,
    tips: Tips,
    motion: np.ndarray,
    depth: np.ndarray,
    mass: float,
    *,
    weight: np.ndarray | float | None = None,
    stiction: float = 0.0,
    h: float = H,
) -> tuple[np.ndarray, int]:
    """Track of a released plate under `depth` (steps,), and the steps taken."""
    sensor = np.zeros((len(depth), 5))
    sensor[:, 2] = depth
    pull = np.broadcast_to(mass * G if weight is None else weight, len(depth)).astype(float)
    track, load = np.zeros((len(depth), track_width(19))), np.zeros((len(depth), 57))
    done = advance_free(
        springs, tips, new_scratch(19), h, sensor, motion, mass, pull, stiction, -25.0, track, load
    )
    return track[:done], done


def at_the_limit(springs: Springs, depth: float) -> tuple[Tips, float]:
    """Tips that pull up with all the friction they have, and that force, N."""
    tips = pressed(springs, depth)
    limit = MU * tips.normal
    tips.place[:, 1] = tips.base[:, 1] - limit / springs.tangential
    tips.mode[:] = STUCK
    return tips, float(limit.sum())


@pytest.mark.parametrize("excess", [-1e-9, 0.0, 1e-9])
def test_a_balanced_plate_does_not_move(excess: float) -> None:
    springs = springs_of()
    tips, force = at_the_limit(springs, 2.8)
    motion = np.zeros(2)
    fall(springs, tips, motion, np.full(50, 2.8), force / G * (1 + excess))
    assert abs(motion[1]) < 1e-6  # mm/s


def test_a_plate_one_part_in_a_thousand_too_heavy_slips() -> None:
    springs = springs_of()
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
    assert np.all(track[:, 57] <= 1e-12)


def test_a_sudden_release_slips_where_a_slow_one_does_not() -> None:
    springs = springs_of()
    slid = {}
    for name, ramp_s in (("sudden", 1e-3), ("slow", 2.0)):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        ramp = np.minimum(np.arange(1, 4001) * H / ramp_s, 1.0) * 0.19 * G
        fall(springs, tips, motion, np.full(4000, 3.4), 0.19, weight=ramp)
        slid[name] = tips.path.max()
    assert slid["slow"] == 0.0
    assert slid["sudden"] > 0.0


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
    slid = track[:, 38:57] - start
    first = np.argmax(slid > 1e-6, axis=0) * H
    moved = np.argmax(slid > 0.167, axis=0) * H
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


def test_chunks_do_not_matter() -> None:
    springs = springs_of(static_excess=0.03, relaxation_share=0.2)
    depth = 3.4 - 0.5 * np.arange(1, 1501) * H
    results = []
    for size in (1500, 1):
        tips, motion = pressed(springs, 3.4), np.zeros(2)
        for k in range(0, 1500, size):
            _, done = fall(springs, tips, motion, depth[k : k + size], 0.205)
            assert done == size
        results.append((motion.copy(), tips))
    (first, tips), (second, others) = results
    assert np.array_equal(first, second)
    for a, b in zip(tips, others, strict=True):
        assert np.array_equal(a, b)
