"""Spots on the plate on which friction differs: tips that stand on them, and slide across them."""

from dataclasses import replace

import numpy as np
import pytest

from sliplab.plugins.simulation.scene.springs import Springs
from tests.plugins.simulation.scene.steps import (
    MU,
    RICH,
    at,
    fall,
    ideal_skin,
    line,
    places,
    pressed,
    rough,
    run,
    springs_of,
)

DEPTH, SPEED, H = 2.8, 2.0, 1e-3


def spotted(springs: Springs, *spots: tuple[float, float, float, float]) -> Springs:
    return replace(springs, spots=np.array(spots))


def slide(springs: Springs, mm: float, h: float = H) -> tuple[np.ndarray, np.ndarray]:
    """Track and load of a slide along x at 2 mm/s."""
    steps = round(mm / SPEED / h)
    return run(springs, pressed(springs, DEPTH), line((0, 0, DEPTH), (mm, 0, DEPTH), steps), h)


def test_a_tip_on_a_spot_slips_earlier_by_the_factor() -> None:
    clean = springs_of(ideal_skin(), level=1)
    i, factor = 7, 0.6  # an outer papilla
    springs = spotted(clean, (*clean.layout[i], 1.5, factor))
    expected_s = MU * clean.normal * (DEPTH - clean.gap) / clean.tangential / SPEED
    for tested, share in ((clean, 1.0), (springs, factor)):
        track, _ = slide(tested, 1.5)
        slipped_s = track[-1, 3 * 19 : 4 * 19]
        assert slipped_s[i] == pytest.approx(share * expected_s[i], rel=1e-9)
        others = np.delete(np.arange(7, 19), 0)
        assert slipped_s[others] == pytest.approx(expected_s[others], rel=1e-9)


def test_a_tip_that_crosses_a_spot_lags_less_on_it_by_the_factor() -> None:
    clean = springs_of(ideal_skin(), level=1)
    i, factor, radius = 7, 0.6, 1.0
    x0, y0 = clean.layout[i]
    near, far = x0 + 1.0, x0 + 1.0 + 2.0 * radius
    springs = spotted(clean, (near + radius, y0, radius, factor))
    track, load = slide(springs, 6.0)
    tip, force = track[:, 2 * i], load[:, i, 0]
    base = x0 + SPEED * H * np.arange(1, len(track) + 1)
    cone = MU * clean.normal[i] * (DEPTH - clean.gap[i])
    lag = cone / clean.tangential[i]
    step_mm = SPEED * H
    sliding = (base > x0 + lag + step_mm) & (base < near + lag - step_mm)
    assert sliding.sum() > 50
    assert base[sliding] - tip[sliding] == pytest.approx(lag, rel=1e-9)
    # it leaps as it comes onto the spot, and is on it until its base is that far behind its end
    on = (base > near + lag + 2 * step_mm) & (base < far + factor * lag - step_mm)
    assert on.sum() > 500
    assert base[on] - tip[on] == pytest.approx(factor * lag, rel=1e-9)
    assert force[on] == pytest.approx(factor * cone, rel=1e-9)
    # behind it, it is stuck until it is bent as before
    stuck = (base > far + factor * lag + 2 * step_mm) & (base < far + lag - step_mm)
    assert np.ptp(tip[stuck]) < 1e-12
    assert tip[stuck][0] == pytest.approx(far, abs=2 * step_mm)
    behind = base > far + lag + 2 * step_mm
    assert base[behind] - tip[behind] == pytest.approx(lag, rel=1e-9)


@pytest.mark.parametrize("factor", [0.3, 2.5])
def test_shorter_steps_change_a_crossing_by_a_step_at_most(factor: float) -> None:
    skin = ideal_skin()
    springs = rough(skin, 0.05, 1, **RICH)
    springs = spotted(springs, (7.0, 1.0, 3.0, factor), (-9.0, -2.0, 2.0, factor))
    fine, _ = slide(springs, 6.0, 5e-4)
    coarse, _ = slide(springs, 6.0, 4e-3)
    clean, _ = slide(replace(springs, spots=np.empty((0, 4))), 6.0, 4e-3)
    away = np.abs(fine[7::8, :38] - coarse[:, :38])
    assert np.abs(clean - coarse)[:, :38].max() > 0.1
    # a leap lasts a few steps, in which one is ahead of the other
    assert np.quantile(away, 0.99) < 2 * SPEED * 4e-3
    assert away[-1].max() < 2 * SPEED * 4e-3


@pytest.mark.long
def test_a_plate_that_is_one_spot_has_other_friction() -> None:
    skin, factor = ideal_skin(), 0.6
    spot = spotted(springs_of(skin, 3, **RICH), (0.0, 0.0, 100.0, factor))
    other = springs_of(skin, 3, mu=factor * MU, **RICH)
    track, load = slide(spot, 5.0)
    expected, expected_load = slide(other, 5.0)
    assert places(track) == pytest.approx(places(expected), abs=1e-9)
    assert load == pytest.approx(expected_load, abs=1e-9)


def test_a_falling_plate_takes_its_spots_with_it() -> None:
    skin, factor = ideal_skin(), 0.6
    depth = np.linspace(2.8, 1.2, 1500)
    tracks = []
    for springs in (
        spotted(springs_of(skin, 3), (0.0, 0.0, 100.0, factor)),
        springs_of(skin, 3, mu=factor * MU),
        springs_of(skin, 3),
        # far above all tips at first
        spotted(springs_of(skin, 3), (0.0, 18.0, 5.0, factor)),
    ):
        track, _ = fall(springs, pressed(springs), np.zeros(2), depth, 0.08)
        tracks.append(track)
    assert tracks[0][:, -1] == pytest.approx(tracks[1][: len(tracks[0]), -1], abs=1e-9)
    assert tracks[0][-1, -1] < tracks[2][len(tracks[0]) - 1, -1] - 0.1
    # as long as the plate has not brought it to them
    assert np.array_equal(tracks[3][:300], tracks[2][:300], equal_nan=True)
    assert not np.array_equal(tracks[3], tracks[2], equal_nan=True)


@pytest.mark.parametrize("cut", [1, 777, 1500])
def test_chunks_do_not_matter(cut: int) -> None:
    skin = ideal_skin()
    springs = rough(skin, 0.05, 1, static_excess=0.03)
    springs = spotted(springs, (7.0, 1.0, 3.0, 0.5), (8.0, 0.0, 2.0, 1.5))
    way = np.concatenate([at(0, 0, DEPTH, 100), line((0, 0, DEPTH), (6, 1, DEPTH), 2900)])
    whole, load = run(springs, pressed(springs, DEPTH), way)
    tips = pressed(springs, DEPTH)
    t_ns = np.arange(len(way) + 1, dtype=np.int64) * 1_000_000
    first, _ = run(springs, tips, way[:cut], t_ns=t_ns[: cut + 1])
    second, rest = run(springs, tips, way[cut:], t_ns=t_ns[cut:])
    assert np.array_equal(np.concatenate([first, second]), whole, equal_nan=True)
    assert np.array_equal(rest, load[cut:])


def test_nothing_changes_under_a_spot_that_no_tip_meets() -> None:
    clean = springs_of(ideal_skin(), static_excess=0.03, strengthening=0.01)
    far = spotted(clean, (100.0, 0.0, 5.0, 0.1))
    for one, other in zip(slide(clean, 4.0), slide(far, 4.0), strict=True):
        assert np.array_equal(one, other, equal_nan=True)
