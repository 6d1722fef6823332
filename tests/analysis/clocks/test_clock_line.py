"""The covariance of a line whose knots the pulses told, against the whole linear model."""

from __future__ import annotations

import numpy as np
import pytest

from sliplab.analysis.clocks.clock_line import _with_places
from sliplab.analysis.clocks.pulse_kernels import normal_equations, places_of


@pytest.mark.parametrize("places", [[], [1], [1, 3]])
def test_a_place_that_is_told_has_a_value_on_either_side(places: list[int]) -> None:
    rng = np.random.default_rng(len(places))
    x = np.sort(rng.uniform(0, 100, 500))
    knots = np.array([x[0], 20.0, 45.0, 80.0, x[-1]])
    piece, share = places_of(x, knots)
    none = np.zeros(x.size)
    matrix = normal_equations(piece, share, none, none, np.inf, np.inf, knots.size)[0]
    found = _with_places(matrix, piece, share, np.array(places, np.int64))
    hats = np.stack([np.interp(x, knots, each) for each in np.eye(knots.size)], axis=1)
    steps = np.stack([x >= knots[place] for place in places] or [none], axis=1) * 1.0
    design = np.concatenate([hats, steps], axis=1) if places else hats
    covariance = np.linalg.inv(design.T @ design)
    # the line before each knot, and behind those that were told
    at_knots = np.eye(knots.size)
    before = [np.append(at_knots[k], [place < k for place in places]) for k in range(knots.size)]
    behind = [np.append(at_knots[k], [place <= k for place in places]) for k in places]
    reported = np.array([*before, *behind], float)
    assert found == pytest.approx(reported @ covariance @ reported.T, rel=1e-6)
