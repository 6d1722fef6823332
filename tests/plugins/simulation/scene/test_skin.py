"""The stiffnesses against numbers worked out by hand, and the layout against its symmetry."""

import math

import numpy as np
import pytest
from pydantic import ValidationError

from sliplab.plugins.simulation.scene.skin import (
    SkinGeometry,
    bending_stiffness,
    make_skin,
    normal_stiffness,
    series_compliance,
)
from sliplab.plugins.simulation.settings import MockSettings, skin_of

HEIGHTS = np.array([10.1, 9.0, 7.9])


def tangential_stiffness(geometry: SkinGeometry, height_mm: np.ndarray) -> np.ndarray:
    return 1 / (1 / bending_stiffness(geometry, height_mm) + series_compliance(geometry, height_mm))


def test_normal_stiffness_lies_where_it_was_worked_out() -> None:
    stiffness = normal_stiffness(SkinGeometry(), HEIGHTS)
    assert stiffness == pytest.approx([0.1249, 0.1272, 0.1296], abs=1e-4)
    rigid = SkinGeometry(base_normal_n_per_m=None)
    assert normal_stiffness(rigid, HEIGHTS)[0] == pytest.approx(0.6 * math.pi * 4 / 10.1)


def test_tangential_stiffness_without_its_base() -> None:
    rigid = SkinGeometry(base_tangential_n_per_m=None)
    assert tangential_stiffness(rigid, HEIGHTS) == pytest.approx([0.063, 0.083, 0.112], abs=6e-4)


def test_the_base_is_in_series() -> None:
    rigid = tangential_stiffness(SkinGeometry(base_tangential_n_per_m=None), HEIGHTS)
    soft = tangential_stiffness(SkinGeometry(), HEIGHTS)
    assert 1 / soft == pytest.approx(1 / rigid + 5.0)


def test_a_free_end_is_softer_than_a_guided_one() -> None:
    free, guided = SkinGeometry(bending=3.0), SkinGeometry()
    assert np.all(tangential_stiffness(free, HEIGHTS) < tangential_stiffness(guided, HEIGHTS))


def test_layout_is_hexagonal_without_scatter() -> None:
    skin = make_skin(SkinGeometry(), seed=5)
    assert len(skin) == 19
    assert np.bincount(skin.ring).tolist() == [1, 6, 12]
    assert skin.gap_mm == pytest.approx(1.1 * skin.ring)
    turn = np.exp(1j * math.pi / 3) * (skin.layout_mm @ [1, 1j])
    for place in turn:
        assert np.abs(skin.layout_mm @ [1, 1j] - place).min() < 1e-12


def test_scatter_belongs_to_its_seed_and_stays_small() -> None:
    geometry = SkinGeometry(height_scatter_mm=0.08, position_scatter_mm=0.05, friction_scatter=0.05)
    first, again, other = (make_skin(geometry, seed) for seed in (1, 1, 2))
    assert np.array_equal(first.gap_mm, again.gap_mm)
    assert not np.array_equal(first.gap_mm, other.gap_mm)
    ideal = make_skin(SkinGeometry(), 1)
    assert np.abs(first.gap_mm - ideal.gap_mm).max() <= 0.16 + 1e-12
    assert np.abs(first.layout_mm - ideal.layout_mm).max() <= 0.1 + 1e-12
    assert first.gap_mm.min() == 0.0
    assert np.all(first.gap_mm[first.ring == 2] < 2.4)


def test_a_skin_that_states_its_papillae_is_the_one_that_was_drawn() -> None:
    drawn = skin_of(MockSettings(seed=7))
    ideal = make_skin(SkinGeometry(), 1)
    papillae = [
        {
            "height_mm": float(drawn.height_mm[k]),
            "friction": float(drawn.friction_factor[k]),
            "offset_mm": (drawn.layout_mm[k] - ideal.layout_mm[k]).tolist(),
        }
        for k in range(len(drawn))
    ]
    stated = skin_of(
        MockSettings.model_validate({"seed": 8, "scene": {"skin": {"papillae": papillae}}})
    )
    for name in ("gap_mm", "height_mm", "normal_n_per_mm", "bending_n_per_mm", "friction_factor"):
        assert np.array_equal(getattr(stated, name), getattr(drawn, name)), name
    assert stated.layout_mm == pytest.approx(drawn.layout_mm, abs=1e-12)


def test_a_skin_states_all_of_its_papillae_or_none() -> None:
    papillae = [{"height_mm": 10.0}] * 18
    with pytest.raises(ValidationError, match=r"must be the 19 of ring_counts, or null"):
        MockSettings.model_validate({"scene": {"skin": {"papillae": papillae}}})
