"""The contact law on the cases that simple friction models get wrong."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigs.scene.contact import (
    FREE,
    SLIDING,
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
from rigs.scene.skin import Skin, SkinGeometry, make_skin

MU = 0.85
H = 1e-3


def ideal_skin() -> Skin:
    return make_skin(SkinGeometry(), seed=1)


def springs_of(skin: Skin, mu: float = MU, **options: float) -> Springs:
    return make_springs(skin, friction=friction_field(skin, mu, 0.0, 0.5, 1), **options)


def run(
    springs: Springs, tips: Tips, sensor: np.ndarray, h: float = H
) -> tuple[np.ndarray, np.ndarray]:
    """Track (steps, 3 n + 1) and load (steps, n, 3) of `tips` under `sensor` (steps, 2 or 3)."""
    n, steps = len(springs.gap), len(sensor)
    full = np.zeros((steps, 5))
    full[:, : sensor.shape[1]] = sensor
    track, load = np.zeros((steps, track_width(n))), np.zeros((steps, 3 * n))
    advance(springs, tips, new_scratch(n), h, full, np.zeros(steps + 1), track, load)
    return track, load.reshape(steps, n, 3)


def at(x: float, y: float, depth: float, steps: int = 1) -> np.ndarray:
    return np.tile([x, y, depth], (steps, 1)).astype(float)


def line(start: tuple[float, ...], end: tuple[float, ...], steps: int) -> np.ndarray:
    share = np.arange(1, steps + 1)[:, None] / steps
    return np.asarray(start) + share * (np.asarray(end) - np.asarray(start))


def pressed(springs: Springs, depth: float = 2.8) -> Tips:
    tips = new_tips(len(springs.gap))
    run(springs, tips, line((0, 0, 0), (0, 0, depth), 200))
    return tips


def copy_of(tips: Tips) -> Tips:
    return Tips(*(array.copy() for array in tips))


def test_zero_speed_leaves_the_state_to_the_bit() -> None:
    springs = springs_of(ideal_skin(), static_excess=0.03)
    tips = pressed(springs)
    run(springs, tips, line((0, 0, 2.8), (3.3, 1.7, 2.8), 1000))
    run(springs, tips, at(3.3, 1.7, 2.8))  # the modes of tips that slid a moment ago settle
    before = copy_of(tips)
    run(springs, tips, at(3.3, 1.7, 2.8, 500))
    for name, old, new in zip(Tips._fields, before, tips, strict=True):
        assert np.array_equal(old, new), name


def test_slip_starts_at_mu_n_over_k_on_a_straight_path_whatever_the_step() -> None:
    skin = ideal_skin()
    springs = springs_of(skin)
    for steps in (7, 100, 15000):
        tips = pressed(springs)
        normal = tips.normal.copy()
        slip_at = MU * normal / skin.tangential_n_per_mm
        track, _ = run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), steps))
        moved = np.arange(1, steps + 1) * 15 / steps
        slid = track[:, 38:57]
        assert slid == pytest.approx(np.maximum(moved[:, None] - slip_at, 0.0), abs=1e-9)
        assert np.all(tips.mode == SLIDING)


@pytest.mark.parametrize("depth", [2.4, 2.8, 3.4])
@pytest.mark.parametrize("direction", range(0, 360, 45))
def test_slip_runs_from_the_outer_layer_to_the_centre(depth: float, direction: int) -> None:
    geometry = SkinGeometry(height_scatter_mm=0.08, position_scatter_mm=0.05, friction_scatter=0.05)
    skin = make_skin(geometry, seed=3)
    field = friction_field(skin, MU, 0.05, 0.5, seed=9)
    springs = make_springs(skin, friction=field, static_excess=0.03, relaxation_share=0.2)
    tips = pressed(springs, depth)
    angle = math.radians(direction)
    track, _ = run(
        springs, tips,
        line((0, 0, depth), (15 * math.cos(angle), 15 * math.sin(angle), depth), 5000),
    )  # fmt: skip
    first = np.argmax(track[:, 38:57] > 1e-9, axis=0)
    outer, middle, centre = (first[skin.ring == ring] for ring in (2, 1, 0))
    assert np.all(track[-1, 38:57] > 0)
    assert outer.max() < middle.min()
    assert middle.max() < centre.min()


def test_reversal_slips_back_only_after_twice_the_slip_displacement() -> None:
    skin = ideal_skin()
    springs = springs_of(skin)
    tips = pressed(springs)
    slip_at = MU * tips.normal / skin.tangential_n_per_mm
    run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 100))
    slid = tips.path.copy()
    track, _ = run(springs, tips, line((15, 0, 2.8), (0, 0, 2.8), 15000))
    back = np.arange(1, 15001) / 1000
    expected = slid + np.maximum(back[:, None] - 2 * slip_at, 0.0)
    assert track[:, 38:57] == pytest.approx(expected, abs=1e-10)


def test_a_tip_without_load_follows_its_base() -> None:
    springs = springs_of(ideal_skin())
    tips = new_tips(19)
    track, load = run(springs, tips, line((0, 0, 1.0), (5, 3, 1.0), 50))
    outer = np.flatnonzero(springs.gap > 1.5)
    assert np.all(tips.mode[outer] == FREE)
    assert tips.place[outer] == pytest.approx(springs.layout[outer] + [5, 3])
    assert np.all(np.isfinite(track))
    assert np.all(load[:, outer] == 0.0)


def test_equal_static_and_kinetic_friction_makes_no_jump() -> None:
    springs = springs_of(ideal_skin())
    tips = pressed(springs)
    _, load = run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 15000))
    change = np.diff(load[:, :, 0], axis=0)
    assert change.max() <= springs.tangential.max() * 1e-3 * (1 + 1e-9)
    assert change.min() > -1e-13


def test_static_friction_drops_by_its_excess() -> None:
    springs = springs_of(ideal_skin(), static_excess=0.03)
    tips = pressed(springs)
    _, load = run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 15000))
    normal = tips.normal
    assert load[:, :, 0].max(axis=0) == pytest.approx(1.03 * MU * normal, rel=1e-9)
    assert load[-1, :, 0] == pytest.approx(MU * normal, rel=1e-9)


def test_huge_stiffness_and_long_steps_stay_finite_and_inside_the_cone() -> None:
    springs = springs_of(ideal_skin())
    stiff = springs._replace(tangential=springs.tangential * 1e9, normal=springs.normal * 1e9)
    tips = new_tips(19)
    run(stiff, tips, at(0, 0, 2.8, 3), h=0.01)
    track, load = run(stiff, tips, line((0, 0, 2.8), (15, 4, 2.8), 1500), h=0.01)
    assert np.all(np.isfinite(track))
    assert np.all(np.isfinite(load))
    assert np.all(np.hypot(load[..., 0], load[..., 1]) <= MU * load[..., 2] * (1 + 1e-12))


def test_long_and_short_steps_hold_alike() -> None:
    springs = springs_of(ideal_skin(), relaxation_share=0.2, relaxation_s=1.0)
    loads = []
    for h, steps in ((0.5, 40), (10.0, 2)):
        tips = pressed(springs)
        run(springs, tips, line((0, 0, 2.8), (0.4, 0.1, 2.8), 400))
        _, load = run(springs, tips, at(0.4, 0.1, 2.8, steps), h=h)
        loads.append(load[-1])
    assert loads[0] == pytest.approx(loads[1], abs=1e-9)


def test_a_thousand_seconds_of_holding_do_not_drift() -> None:
    springs = springs_of(ideal_skin())
    tips = pressed(springs)
    run(springs, tips, line((0, 0, 2.8), (2, 0, 2.8), 2000))
    before = tips.place.copy()
    run(springs, tips, at(2, 0, 2.8, 10_000), h=0.1)
    assert np.array_equal(before, tips.place)


def test_relaxation_takes_away_its_share() -> None:
    springs = springs_of(ideal_skin(), relaxation_share=0.2, relaxation_s=1.0)
    tips = new_tips(19)
    run(springs, tips, at(0, 0, 2.8), h=1e-6)
    sudden = tips.normal.copy()
    run(springs, tips, at(0, 0, 2.8, 30), h=1.0)
    assert tips.normal / sudden == pytest.approx(np.full(19, 0.8), rel=1e-5)
    assert tips.normal == pytest.approx(springs.normal * (2.8 - springs.gap), rel=1e-9)


def test_falling_normal_force_slips_without_any_motion_of_the_base() -> None:
    springs = springs_of(ideal_skin())
    tips = pressed(springs, 3.2)
    run(springs, tips, line((0, 0, 3.2), (0.5, 0, 3.2), 500))
    assert np.all(tips.path == 0.0)
    track, load = run(springs, tips, line((0.5, 0, 3.2), (0.5, 0, 0.1), 3100))
    assert np.all(tips.path > 0.0)
    in_contact = load[..., 2] > 0
    size = np.hypot(load[..., 0], load[..., 1])
    assert np.all(size[in_contact] <= MU * load[..., 2][in_contact] * (1 + 1e-12))
    assert np.all(np.isfinite(track))


def test_rising_normal_force_sticks_again() -> None:
    springs = springs_of(ideal_skin())
    tips = pressed(springs, 2.4)
    run(springs, tips, line((0, 0, 2.4), (12, 0, 2.4), 12000))
    assert np.all(tips.mode == SLIDING)
    run(springs, tips, line((12, 0, 2.4), (12.01, 0, 3.0), 10))
    assert np.all(tips.mode == STUCK)


def test_leaving_and_touching_again_resets_the_slider() -> None:
    springs = springs_of(ideal_skin(), relaxation_share=0.2)
    tips = pressed(springs)
    run(springs, tips, line((0, 0, 2.8), (3, 0, 2.8), 3000))
    run(springs, tips, line((3, 0, 2.8), (3, 0, -1.0), 500))
    assert np.all(tips.mode == FREE)
    run(springs, tips, line((3, 0, -1.0), (3, 0, 2.8), 500))
    assert np.all(tips.force == 0.0)
    assert tips.place == pytest.approx(springs.layout + np.array([3, 0]))


def test_a_turn_by_90_degrees_follows_the_tractrix_at_first_order() -> None:
    springs = springs_of(ideal_skin())
    errors = []
    for steps in (200, 400, 800):
        tips = pressed(springs)
        run(springs, tips, line((0, 0, 2.8), (15, 0, 2.8), 100))
        radius = MU * tips.normal / springs.tangential
        run(springs, tips, line((15, 0, 2.8), (15, 2, 2.8), steps))
        angle = np.arctan2(tips.force[:, 0], tips.force[:, 1])
        exact = 2 * np.arctan(np.exp(-2.0 / radius))
        errors.append(np.abs(angle - exact).max())
    assert errors[2] < 0.01
    assert errors[0] / errors[1] == pytest.approx(2.0, abs=0.3)
    assert errors[1] / errors[2] == pytest.approx(2.0, abs=0.3)


def test_turning_the_scene_turns_the_result() -> None:
    springs = springs_of(ideal_skin(), relaxation_share=0.2, static_excess=0.03)
    results = []
    for turns in (0, 1):
        spin = np.exp(1j * math.pi / 3 * turns)
        tips = pressed(springs)
        for start, end in ((0 + 0j, 6 + 1j), (6 + 1j, 5 + 4j)):
            a, b = start * spin, end * spin
            run(springs, tips, line((a.real, a.imag, 2.8), (b.real, b.imag, 2.8), 1500))
        results.append((springs.layout @ [1, 1j], tips.place @ [1, 1j], tips.force @ [1, 1j], spin))
    (layout, place, force, _), (_, turned_place, turned_force, spin) = results
    partner = [int(np.abs(layout - spot * spin).argmin()) for spot in layout]
    assert turned_place[partner] == pytest.approx(place * spin, abs=1e-9)
    assert turned_force[partner] == pytest.approx(force * spin, abs=1e-9)


def test_chunks_do_not_matter() -> None:
    skin = make_skin(SkinGeometry(height_scatter_mm=0.08), seed=2)
    springs = make_springs(
        skin, friction=friction_field(skin, MU, 0.05, 0.5, 4), static_excess=0.03,
        relaxation_share=0.2,
    )  # fmt: skip
    path = np.vstack([
        line((0, 0, 0), (0, 0, 2.6), 300), line((0, 0, 2.6), (4, 2, 2.6), 700),
    ])  # fmt: skip
    whole, parts = new_tips(19), new_tips(19)
    track, _ = run(springs, whole, path)
    pieces = [run(springs, parts, path[k : k + 1])[0] for k in range(len(path))]
    assert np.array_equal(track, np.vstack(pieces))
    for a, b in zip(whole, parts, strict=True):
        assert np.array_equal(a, b)


def test_friction_varies_by_as_much_and_as_fast_as_it_is_told() -> None:
    skin = ideal_skin()
    field = friction_field(skin, MU, 0.05, 0.5, seed=3)
    assert np.array_equal(field, friction_field(skin, MU, 0.05, 0.5, seed=3))
    assert not np.array_equal(field, friction_field(skin, MU, 0.05, 0.5, seed=4))
    relative = field / MU - 1
    assert relative.std() == pytest.approx(0.05, rel=0.05)
    correlation = (relative * np.roll(relative, 5, axis=1)).mean() / relative.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.05)


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 1000),
    waypoints=st.lists(
        st.tuples(st.floats(-8, 8), st.floats(-8, 8), st.floats(-1, 3.6)), min_size=1, max_size=5
    ),
    share=st.sampled_from([0.0, 0.2]),
    excess=st.sampled_from([0.0, 0.03, 0.2]),
    h=st.sampled_from([1e-3, 1e-2]),
)
def test_every_force_stays_inside_its_cone(
    seed: int, waypoints: list[tuple[float, float, float]], share: float, excess: float, h: float
) -> None:
    skin = make_skin(SkinGeometry(height_scatter_mm=0.08, friction_scatter=0.05), seed)
    springs = make_springs(
        skin, friction=friction_field(skin, MU, 0.0, 0.5, seed), static_excess=excess,
        relaxation_share=share,
    )  # fmt: skip
    tips, last = new_tips(19), (0.0, 0.0, -1.0)
    for waypoint in waypoints:
        track, load = run(springs, tips, line(last, waypoint, 60), h)
        last = waypoint
        assert np.all(np.isfinite(track))
        assert np.all(np.isfinite(load))
        size = np.hypot(load[..., 0], load[..., 1])
        cone = MU * skin.friction_factor * load[..., 2]
        assert np.all(size <= cone * (1 + excess) * (1 + 1e-12))
