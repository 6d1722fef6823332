"""Onsets in closed form against the contact solver, which knows nothing of them."""

import numpy as np
import pytest

from benchmarks.one_slide import run_slide
from sliplab.plugins.simulation.scene.friction import friction_knots
from sliplab.plugins.simulation.scene.onsets import Material, retraction_onsets, slide_onsets
from sliplab.plugins.simulation.scene.skin import SkinGeometry, make_skin
from sliplab.plugins.simulation.scene.springs import make_springs, new_tips
from tests.plugins.simulation.scene.steps import MU, H, fall, ideal_skin, line, run, slid

MATERIAL = Material(MU, static_excess=0.03, relaxation_share=0.2, relaxation_s=1.0)
SKIN = make_skin(
    SkinGeometry(height_scatter_mm=0.08, position_scatter_mm=0.05, friction_scatter=0.05), 3
)


@pytest.mark.parametrize("level", [1, 2, 3])
@pytest.mark.parametrize(("depth", "speed"), [(2.4, 1.6), (2.8, 1.0), (3.4, 0.6)])
def test_slides_let_go_when_expected(level: int, depth: float, speed: float) -> None:
    springs = make_springs(
        SKIN,
        friction_knots(SKIN, MU, 0.0, 0.5, 1),
        level,
        static_excess=0.03,
        relaxation_share=0.2,
        relaxation_s=1.0,
    )
    found = run_slide(springs, depth, speed, 30.0, settled_s=2.0, step_mm=0.01).slipped_s
    expected = slide_onsets(SKIN, MATERIAL, level, depth, speed, 2.0, 2.0)
    assert found == pytest.approx(expected, abs=1e-9)


def test_many_slides_at_once_are_the_same_as_one_by_one() -> None:
    depths, speeds = [2.4, 3.0, 3.4], [0.6, 1.0, 1.6]
    together = slide_onsets(SKIN, MATERIAL, 3, depths, speeds)
    assert together.shape == (3, 19)
    for row, depth, speed in zip(together, depths, speeds, strict=True):
        assert row == pytest.approx(slide_onsets(SKIN, MATERIAL, 3, depth, speed), rel=1e-9)


def test_a_tip_that_does_not_touch_never_slips() -> None:
    onsets = slide_onsets(ideal_skin(), MATERIAL, 3, 1.5, 1.0)
    assert np.all(np.isinf(onsets[7:]))
    assert np.all(np.isfinite(onsets[:7]))


@pytest.mark.parametrize("mass", [0.12, 0.165])
def test_a_hanging_plate_slips_and_falls_when_expected(mass: float) -> None:
    skin = ideal_skin()
    springs = make_springs(skin, np.full((19, 1), MU), 1, damping_s=0.01)
    tips, motion = new_tips(19), np.zeros(2)
    run(springs, tips, line((0, 0, 0), (0, 0, 3.4), 300))
    weight = np.minimum(np.arange(1, 6001) / 4000, 1.0) * mass * 9.81
    fall(springs, tips, motion, np.full(6000, 3.4), mass, weight=weight)
    assert np.all(tips.path == 0)
    track, done = fall(springs, tips, motion, 3.4 - 0.3 * np.arange(1, 9001) * H, mass)
    first, gross = retraction_onsets(skin, MU, mass, 3.4, 0.3)
    way = slid(track)
    assert np.argmax(way.max(axis=1) > 1e-9) * H == pytest.approx(first, abs=5e-3)
    # it falls 25 mm within a fraction of a second of the moment at which friction is used up
    assert done * H - gross == pytest.approx(0.15, abs=0.15)


def test_a_plate_that_is_too_heavy_never_hangs() -> None:
    assert retraction_onsets(ideal_skin(), MU, 2.0, 3.4, 0.3) == (np.inf, np.inf)
