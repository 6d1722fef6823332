"""Boundaries of several looks, against closed forms, another library and random walks."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from sliplab.plugins.claims.boundaries import POWER, boundaries


def test_one_look_has_the_boundary_of_a_fixed_sample() -> None:
    assert boundaries((1.0,), 0.05)[0] == pytest.approx(norm.isf(0.05), abs=1e-6)


@pytest.mark.parametrize("error", [0.01, 0.05, 0.3])
def test_two_looks_spend_the_error_as_a_bivariate_normal_says(error: float) -> None:
    share = 0.7
    first, second = boundaries((share, 1.0), error)
    assert norm.sf(first) == pytest.approx(error * share**POWER, rel=1e-6)
    correlation = np.sqrt(share)
    inside = multivariate_normal([0, 0], [[1, correlation], [correlation, 1]]).cdf([first, second])
    assert 1 - inside == pytest.approx(error, abs=2e-4)


def test_a_random_walk_crosses_any_of_many_boundaries_as_seldom_as_stated() -> None:
    looks, walks = 24, 40_000
    limits = boundaries(tuple((np.arange(looks) + 1) / looks), 0.05)
    steps = np.random.default_rng(1).normal(size=(walks, looks))
    z = np.cumsum(steps, axis=1) / np.sqrt(np.arange(looks) + 1)
    crossed = (z > limits).any(axis=1).mean()
    assert crossed == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / walks))


def test_the_last_boundary_is_close_to_that_of_one_look() -> None:
    for looks in (3, 24, 72):
        limits = boundaries(tuple((np.arange(looks) + 1) / looks), 0.025)
        assert (np.diff(limits) <= 0).all()
        assert limits[-1] < 1.08 * norm.isf(0.025)


def test_looks_after_the_planned_end_call_nothing() -> None:
    found = boundaries((0.5, 1.0, 1.2), 0.05)
    assert np.isfinite(found[:2]).all()
    assert np.isinf(found[2])
