"""Estimates of the contact from slides drawn with known values, and from simulated ones."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.plugins.simulation.settings import scene_of
from sliplab.plugins.twin.contact_estimates import (
    NOT_LOGGED,
    PapillaEstimates,
    contact_estimates,
    papillae,
    read_contact,
)
from sliplab.plugins.twin.contact_forces import gross_forces, hold_relaxation, ring_stiffness
from sliplab.plugins.twin.contact_lags import Growth, fit_growth, steady_lags
from sliplab.plugins.twin.contact_places import place_scatter, rings_of
from sliplab.plugins.twin.contact_slips import find_slips
from sliplab.plugins.twin.contact_springs import (
    SHORTENING,
    Guess,
    Lags,
    fit_springs,
    steady,
)
from sliplab.plugins.twin.pilot import Forces, PilotTrial, SlideMotion
from sliplab.plugins.twin.pilots import simulate_pilot
from sliplab.protocols.plan import load_plan
from sliplab.rigs.rig_file import load_rig_file
from tests.conftest import ROOT
from tests.patching import loose

RING = np.repeat([0, 1, 2], [1, 6, 12])
ANGLE = np.concatenate([np.arange(n) * 2 * np.pi / n for n in (1, 6, 12)])
LATTICE = 5.6 * RING[:, None] * np.column_stack([np.cos(ANGLE), np.sin(ANGLE)])
STRETCH = np.array([2.4, 1.4, 0.6])[RING]
"""Stretch at which the drawn papillae let go, mm, at the depth 1 mm beyond their gap."""
Tracks = Callable[[np.ndarray, float], np.ndarray]
"""From times (n,) and speed to the tips' paths, (n, m)."""


def estimates(trials: Sequence[PilotTrial]) -> dict[str, float]:
    contact = read_contact(trials)
    assert contact is not None
    return contact_estimates(contact)


def each_papilla(trials: Sequence[PilotTrial]) -> PapillaEstimates | None:
    contact = read_contact(trials)
    assert contact is not None
    return papillae(contact)


def slide(
    tracks: Tracks,
    speed: float = 1.0,
    way: Sequence[float] = (1.0, 0.0),
    depth: float = 2.8,
    noise: float = 2e-4,
    seed: int = 0,
    forces: Callable[[np.ndarray], np.ndarray] | None = None,
) -> PilotTrial:
    """A slide of 9 mm whose tips go as `tracks` says, begun 4.5 mm before the plate's middle."""
    rng = np.random.default_rng(seed)
    t = np.arange(-2.0, 9.0 / speed, 0.01) + 0.003
    direction = np.asarray(way)
    path = np.where(t[:, None] > 0.0, tracks(np.maximum(t, 0.0), speed), 0.0)
    tips = LATTICE - 4.5 * direction + path[..., None] * direction
    tips += rng.normal(0.0, noise, tips.shape)
    base = np.maximum(t, 0.0)[:, None] * speed * direction
    load = None
    if forces is not None:
        force_s = np.arange(-2.0, 9.0 / speed, 0.001)
        load = Forces(force_s, forces(force_s) + rng.normal(0.0, 0.005, (len(force_s), 3)))
    where = SlideMotion(depth, speed, direction)
    return PilotTrial("t", where, -2.0, 9.0 / speed, t, tips, base, None, load)


def coulomb(stretch: np.ndarray) -> Tracks:
    """Springs with a slider each: stuck until they are stretched so far, then at that lag."""
    return lambda t, speed: np.maximum(speed * t[:, None] - stretch, 0.0)


def relaxing(growth: Growth, stretch: np.ndarray) -> Tracks:
    """The same with a standard linear solid, whose lag grows after the slip."""

    def tracks(t: np.ndarray, speed: float) -> np.ndarray:
        stuck = stretch / speed
        after = np.maximum(t[:, None] - stuck, 0.0)
        lag = stretch * growth(stuck, after, np.zeros(1))
        return np.where(after > 0.0, np.maximum(speed * t[:, None] - lag, 0.0), 0.0)

    return tracks


def pilot(tracks: Callable[[float], Tracks], **others: object) -> list[PilotTrial]:
    """Slides at three depths and three speeds in four directions; `tracks` by depth."""
    ways = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)]
    return [
        loose(slide)(tracks(depth), speed, way, depth, seed=number, **others)
        for number, (depth, speed, way) in enumerate(
            (depth, speed, way)
            for depth in (2.4, 2.8, 3.4)
            for speed in (0.6, 1.0, 1.6)
            for way in ways
        )
    ]


def test_a_tip_lets_go_where_its_spring_reaches_friction() -> None:
    # u = mu N / k_t
    stretch = 0.85 * 0.128 * (2.8 - np.array([0.0, 1.1, 2.2])[RING]) / 0.07
    found = find_slips([slide(coulomb(stretch), speed) for speed in (0.6, 1.6)])
    assert found is not None
    np.testing.assert_allclose(found.stretch_mm, np.tile(stretch, (2, 1)), atol=2e-3)
    np.testing.assert_allclose(found.slipped_s[1], stretch / 1.6, atol=2e-3)
    assert found.slid.all()
    lags = steady_lags(found, Growth(maxwell=1e-9)).lag_mm
    np.testing.assert_allclose(lags, np.tile(stretch, (2, 1)), atol=1e-3)


def test_a_papilla_in_the_air_has_no_lag_and_one_that_sticks_none_that_is_known() -> None:
    stretch = STRETCH.copy()
    stretch[3], stretch[8] = 0.0, 100.0
    found = find_slips([slide(coulomb(stretch))])
    assert found is not None
    assert found.free[0].tolist() == [j == 3 for j in range(19)]
    assert np.isnan(found.slipped_s[0, 8])
    lag = steady_lags(found, Growth()).lag_mm[0]
    assert lag[3] == 0.0
    assert np.isnan(lag[8])


def test_lost_frames_and_a_torn_papilla_do_not_move_the_slips() -> None:
    whole = slide(coulomb(STRETCH))
    tips = whole.tips_mm.copy()
    tips[np.random.default_rng(1).random(len(tips)) < 0.2] = np.nan
    tips[:, 5] = np.nan
    found = find_slips([replace(whole, tips_mm=tips)])
    assert found is not None
    others = np.arange(19) != 5
    np.testing.assert_allclose(found.stretch_mm[0, others], STRETCH[others], atol=4e-3)
    assert np.isnan(found.stretch_mm[0, 5])
    ring, _ = rings_of(found)
    assert ring.tolist() == [-1 if j == 5 else r for j, r in enumerate(RING.tolist())]


def test_slides_of_another_skin_are_left_out() -> None:
    one = slide(coulomb(STRETCH))
    other = replace(one, tips_mm=one.tips_mm[:, :7])
    found = find_slips([one, other, one])
    assert found is not None
    assert len(found.trials) == 2
    assert find_slips([]) is None
    assert read_contact([]) is None


@pytest.mark.parametrize(("share", "time"), [(0.1, 0.7), (0.2, 1.0), (0.3, 1.5)])
def test_relaxation_is_read_from_how_lags_grow(share: float, time: float) -> None:
    true = Growth(share / (1 - share), time)
    trials = [slide(relaxing(true, STRETCH), speed, seed=k) for k, speed in enumerate((0.6, 1.6))]
    slips = find_slips(trials)
    assert slips is not None
    found = fit_growth(slips)
    assert found is not None
    assert found.maxwell == pytest.approx(true.maxwell, rel=0.03)
    assert found.relaxation_s == pytest.approx(time, rel=0.03)
    assert found.drop == pytest.approx(0.0, abs=0.002)
    lags = steady_lags(slips, found).lag_mm
    infinite = true(STRETCH / np.array([[0.6], [1.6]]), np.full(1, np.inf), np.zeros(1))
    np.testing.assert_allclose(lags, STRETCH * infinite, rtol=0.01)


def test_what_a_tip_loses_by_letting_go_is_seen() -> None:
    drops = []
    for drop in (0.0, 0.02, 0.04):
        tracks = relaxing(Growth(drop=drop), STRETCH)
        slips = find_slips([slide(tracks, speed, seed=1) for speed in (0.6, 1.6)])
        assert slips is not None
        found = fit_growth(slips)
        assert found is not None
        drops.append(found.drop)
    # a tip that jumps is not seen to begin: its time is uncertain by a part of a frame
    np.testing.assert_allclose(np.diff(drops), 0.02, atol=0.008)


def test_places_are_compared_with_the_best_lattice() -> None:
    turn = np.exp(0.3j)
    moved = ((LATTICE @ [1, 1j]) * turn * 1.02 + (0.7 - 0.2j)).view(np.float64).reshape(-1, 2)
    assert place_scatter(RING, moved) == pytest.approx(0.0, abs=1e-12)
    found = []
    for seed in range(40):
        off = np.random.default_rng(seed).normal(0.0, 0.05, (19, 2))
        found.append(place_scatter(RING, moved + off))
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(0.05, rel=0.05)
    missing = moved.copy()
    missing[[4, 11]] = np.nan
    assert place_scatter(RING, missing) == pytest.approx(0.0, abs=1e-12)
    assert np.isnan(place_scatter(RING[:2], moved[:2]))


def test_friction_along_the_path_gives_its_deviation_and_length() -> None:
    rng = np.random.default_rng(3)
    away = np.arange(-60, 61) * 0.02
    kernel = np.exp(-2 * (away / 0.5) ** 2)
    kernel /= np.sqrt(np.sum(kernel**2))

    def rough(_: float) -> Tracks:
        field = np.array([np.convolve(rng.normal(size=800), kernel, "same") for _ in RING])

        def tracks(t: np.ndarray, speed: float) -> np.ndarray:
            base = speed * t[:, None]
            way = np.maximum(base - STRETCH, 0.0)
            wander = np.array(
                [np.interp(way[:, j], np.arange(800) * 0.02, field[j]) for j in range(19)]
            ).T
            return np.where(way > 0.0, np.maximum(base - STRETCH * (1 + 0.05 * wander), 0.0), 0.0)

        return tracks

    found = estimates(pilot(rough))
    # each path's own mean is taken away: a path of 7 mm has some ten independent places
    assert found["path_variation"] == pytest.approx(0.05, rel=0.12)
    assert found["correlation_mm"] == pytest.approx(0.5, rel=0.12)


def test_the_tremor_along_the_plate_is_told_from_that_of_the_depth() -> None:
    shares = np.random.default_rng(5).random(36)
    trials = []
    for k, trial in enumerate(pilot(lambda _: coulomb(STRETCH))):
        phase = np.random.default_rng(k).uniform(0, 2 * np.pi, 3)
        along = 4.0 if trial.slide.direction[0] else 6.0
        t = trial.frame_s[:, None]
        moves = np.sin(2 * np.pi * along * t + phase[0]) * 0.01 * shares[k]
        deep = np.sin(2 * np.pi * 5.0 * t + phase[1]) * 0.01 * shares[k] * STRETCH
        slides = trial.frame_s[:, None] * trial.slide.speed_mm_s > STRETCH + 0.05
        off = np.where(slides, moves + deep, 0.0)[..., None] * trial.slide.direction
        trials.append(replace(trial, tips_mm=trial.tips_mm + off))
    found = estimates(trials)
    most = np.sort(shares)[-4:].mean() * 0.01
    # friction that is thought to rise with speed keeps back a few per cent
    assert found["tremor_mm"] == pytest.approx(most, rel=0.06)
    assert found["tremor_along_mean_mm"] == pytest.approx(shares.mean() * 0.01, rel=0.06)
    assert 4.4 < found["tremor_hz"] < 5.4
    assert found["tremor_along_hz"] == pytest.approx(np.sqrt(4.0 * 6.0), rel=0.003)


@settings(deadline=None)
@given(
    mu=st.floats(0.4, 1.3),
    deep=st.floats(0.01, 3.0),
    height=st.floats(7.0, 11.0),
    normal=st.floats(2.0, 8.0),
    tangential=st.floats(1.0, 6.0),
)
def test_a_steady_lag_solves_the_equations_of_the_column(
    mu: float, deep: float, height: float, normal: float, tangential: float
) -> None:
    guess = Guess()
    lag, pressed = steady(
        np.array([mu]), np.array([height]), np.array([deep]), normal, tangential, guess
    )
    area, inertia = np.pi * 4.0, np.pi * 4.0
    kappa = 6 * 1.49 / (7 + 6 * 0.49)
    series = height * 2 * 1.49 / (kappa * area) + tangential
    bend = lag - series * mu * pressed
    along = 1.0 / (height / area + normal)
    assert pressed == pytest.approx(along * max(deep - SHORTENING * bend**2 / height, 0), rel=1e-6)
    bending = 12 * inertia / height**3
    spring = max(bending - 2 * SHORTENING * pressed / height, 0.05 * bending)
    assert bend * spring == pytest.approx(mu * pressed, rel=1e-6)


def test_a_light_press_has_the_closed_form() -> None:
    deep, guess = np.array([1e-4]), Guess()
    lag, _ = steady(np.array([0.9]), np.array([9.0]), deep, 4.0, 3.0, guess)
    area = np.pi * 4.0
    kappa = 6 * 1.49 / (7 + 6 * 0.49)
    across = 9.0**3 / (12 * np.pi * 4.0) + 9.0 * 2 * 1.49 / (kappa * area) + 3.0
    assert lag == pytest.approx(0.9 * 1e-4 / (9.0 / area + 4.0) * across, rel=1e-3)


TRUE = {"kinetic": 0.95, "young": 0.5, "normal": 4.5, "tangential": 2.5, "step": 1.2}


def exact_lags(
    forces: bool, zero_mm: float = 0.05, seed: int = 7
) -> tuple[Lags, np.ndarray, np.ndarray]:
    """Lags and forces of known springs, and these, without noise.

    Args:
        zero_mm: by how much the centre papilla is deeper than reported.
    """
    rng = np.random.default_rng(seed)
    friction, raised = 1 + rng.normal(0, 0.05, 19), rng.uniform(-0.08, 0.08, 19)
    depth = np.array([2.4, 2.8, 3.4])
    height = 10.1 - TRUE["step"] * RING + raised
    deep = depth[:, None] + zero_mm - (height[0] - height)
    mu, guess = TRUE["kinetic"] * friction, Guess()
    lag, pressed = steady(mu, height, deep, TRUE["normal"], TRUE["tangential"], guess)
    nothing = np.full(3, np.nan)
    along = TRUE["young"] / (height / (np.pi * 4) + TRUE["normal"])
    resting = (along * np.maximum(deep, 0)).sum(axis=1)
    dragged = TRUE["young"] * mu * pressed
    in_ring = RING[:, None] == np.arange(3)
    lags = Lags(
        depth,
        RING,
        lag,
        np.hypot(0.003 * lag, 1e-3),
        resting if forces else nothing,
        float(dragged.sum() / pressed.sum() / TRUE["young"]) if forces else np.nan,
        TRUE["young"] * pressed.sum(axis=1) / resting if forces else nothing,
        nothing,
        (dragged @ in_ring) / np.maximum(lag @ in_ring, 1e-9) * (1.0 if forces else np.nan),
    )
    return lags, friction, raised


def test_springs_are_found_from_lags_and_forces() -> None:
    lags, friction, raised = exact_lags(forces=True)
    found = fit_springs(lags, Guess())
    assert found is not None
    assert found.kinetic == pytest.approx(TRUE["kinetic"], rel=0.02)
    assert found.youngs_modulus_mpa == pytest.approx(TRUE["young"], rel=0.04)
    assert found.normal_compliance == pytest.approx(TRUE["normal"], rel=0.04)
    assert found.tangential_compliance == pytest.approx(TRUE["tangential"], rel=0.1)
    assert found.layer_step_mm == pytest.approx(TRUE["step"], abs=0.05)
    gap = TRUE["step"] * RING - raised + raised[0]
    assert np.all(np.abs(found.gap_mm - gap) < 3 * found.gap_error_mm + 1e-3)
    assert np.all(np.abs(found.friction / friction - 1) < 3 * found.friction_error)


def test_lags_alone_tell_steps_but_no_force() -> None:
    lags, _, raised = exact_lags(forces=False)
    found = fit_springs(lags, Guess())
    assert found is not None
    assert np.isnan(found.youngs_modulus_mpa)
    assert found.layer_step_mm == pytest.approx(TRUE["step"], abs=0.05)
    inside = found.gap_mm[RING == 2] - found.gap_mm[RING == 2].mean()
    outer = raised[RING == 2]
    np.testing.assert_allclose(inside, outer.mean() - outer, atol=0.01)


@pytest.mark.quick(1)
@pytest.mark.parametrize("seed", range(5))
def test_an_exact_depth_zero_shows_how_much_later_the_rings_touch(seed: int) -> None:
    """Depth zero is where the centre papilla touches, whatever height that came out with."""
    lags, _, raised = exact_lags(forces=True, zero_mm=0.0, seed=seed)
    exact, by_one_touch = (fit_springs(lags, Guess(zero_mm=each)) for each in (0.03, 0.1))
    assert exact is not None
    assert by_one_touch is not None
    outer = RING > 0
    off = (exact.gap_mm - (TRUE["step"] * RING - raised + raised[0]))[outer]
    assert abs(off.mean()) < 0.015
    assert exact.gap_error_mm[outer].max() < 0.85 * by_one_touch.gap_error_mm[outer].max()
    assert abs(exact.zero_mm) < 0.03


def test_a_papilla_that_is_not_there_carries_no_force() -> None:
    lags, _, _ = exact_lags(forces=True)
    ring, lag = np.append(RING, -1), np.column_stack([lags.lag_mm, np.full(3, np.nan)])
    error = np.column_stack([lags.error_mm, np.full(3, np.nan)])
    one = fit_springs(lags, Guess())
    other = fit_springs(replace(lags, ring=ring, lag_mm=lag, error_mm=error), Guess())
    assert one is not None
    assert other is not None
    assert other.youngs_modulus_mpa == pytest.approx(one.youngs_modulus_mpa, rel=1e-3)


def test_forces_are_split_by_the_lags_of_the_rings() -> None:
    stiffness = np.array([0.05, 0.06, 0.075])
    tracks = coulomb(STRETCH)

    def forces(t: np.ndarray) -> np.ndarray:
        lag = np.maximum(t, 0)[:, None] - np.where(t[:, None] > 0, tracks(np.maximum(t, 0), 1.0), 0)
        pull = lag @ stiffness[RING]
        normal = 3.0 + 0.2 * np.exp(-(t + 2.0) / 0.9)
        # a zero that is off, and a hundredth of the normal force in the other axis
        return np.column_stack([pull + 0.1, 0.01 * normal, normal])

    trial = slide(tracks, forces=forces)
    slips = find_slips([trial])
    assert slips is not None
    found = ring_stiffness(slips, RING, Growth(maxwell=1e-9))
    np.testing.assert_allclose(found, [stiffness], rtol=0.01)
    pull, normal = gross_forces(slips)[0]
    assert pull == pytest.approx(STRETCH @ stiffness[RING] + 0.1, rel=0.002)
    assert normal == pytest.approx(3.0, rel=0.002)
    share, time = hold_relaxation(slips)
    assert time == pytest.approx(0.9, rel=0.05)
    assert share == pytest.approx(0.2 / 3.0, rel=0.03)


def test_without_forces_nothing_is_said_of_them() -> None:
    found = estimates(pilot(lambda _: coulomb(STRETCH)))
    for name in (
        "normal_n",
        "ratio",
        "hold_relaxation_s",
        "youngs_modulus_mpa",
        "pull_ring1_n_per_mm",
    ):
        assert np.isnan(found[name])
    assert set(NOT_LOGGED) <= set(found)
    positive = [value for name, value in found.items() if name not in NOT_LOGGED]
    assert all(np.isnan(value) or value > 0.0 for value in positive)


@pytest.mark.parametrize("stretch", [100.0, 0.0, 1.0])
def test_one_slide_of_odd_data_is_no_error(stretch: float) -> None:
    trial = slide(coulomb(np.full(19, stretch)))
    names = set(estimates([trial]))
    blind = replace(trial, tips_mm=np.full(trial.tips_mm.shape, np.nan))
    short = replace(
        trial, frame_s=trial.frame_s[:3], tips_mm=trial.tips_mm[:3], base_mm=trial.base_mm[:3]
    )
    for odd in (blind, short, replace(trial, slide_s=0.0)):
        found = estimates([odd])
        assert set(found) >= names - {name for name in names if name.startswith("pull_")}
        each_papilla([odd])


def test_papillae_have_the_gaps_and_friction_that_were_drawn() -> None:
    rng = np.random.default_rng(11)
    friction, raised = 1 + rng.normal(0, 0.05, 19), rng.uniform(-0.08, 0.08, 19)
    guess = Guess()
    height = 10.1 - 1.1 * RING + raised

    def tracks(depth: float) -> Tracks:
        deep = depth - (10.1 - height)
        return coulomb(steady(0.85 * friction, height, deep, 4.0, 3.0, guess)[0])

    found = each_papilla(pilot(tracks))
    assert found is not None
    assert found.ring.tolist() == RING.tolist()
    gap = 1.1 * RING - raised + raised[0]
    assert np.all(np.abs(found.gap_mm - gap) <= 3 * found.gap_error_mm)
    assert np.all(np.abs(found.friction - friction / friction.mean()) < 3 * found.friction_error)
    outer = RING == 2
    np.testing.assert_allclose(
        found.gap_mm[outer] - found.gap_mm[outer].mean(),
        raised[outer].mean() - raised[outer],
        atol=0.01,
    )
    np.testing.assert_allclose(found.place_mm, LATTICE, atol=1e-3)


def test_simulated_slides_show_the_rig_s_own_settings() -> None:
    plan, (rig, _) = (
        load_plan(ROOT / "protocols/pilot.yaml"),
        load_rig_file(ROOT / "rigs/mock_force.yaml"),
    )
    found = estimates(simulate_pilot(rig, plan, plan.trials[:12], 3, with_events=False))
    scene = scene_of(rig).scene
    assert found["relaxation_s"] == pytest.approx(scene.skin.relaxation_s, rel=0.3)
    assert found["hold_relaxation_s"] == pytest.approx(scene.skin.relaxation_s, rel=0.03)
    share = found["relaxation_maxwell"] / (1 + found["relaxation_maxwell"])
    assert share == pytest.approx(scene.skin.relaxation_share, rel=0.3)
    # friction at rest, and 2.4 % more at 1 mm/s
    assert found["kinetic"] == pytest.approx(scene.friction.kinetic, rel=0.06)
    assert found["layer_step_mm"] == pytest.approx(1.1, rel=0.08)
    assert found["youngs_modulus_mpa"] == pytest.approx(scene.skin.youngs_modulus_mpa, rel=0.15)
    assert found["tremor_hz"] == pytest.approx(scene_of(rig).arm.vibration_hz, rel=0.1)
    assert found["correlation_mm"] == pytest.approx(scene.friction.correlation_mm, rel=0.3)
