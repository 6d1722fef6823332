"""Likelihoods of windows against counting by hand and against a known density ratio."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sliplab.analysis.detectors.detectors import ADDED, fit_histograms, fit_logistic

COUNTS = st.lists(st.tuples(*[st.integers(0, 6)] * 3, st.integers(0, 2)), min_size=3, max_size=40)


def test_histograms_are_shares_with_half_a_window_more_in_every_bin() -> None:
    seen = np.array([[0], [0], [2], [5]])
    fitted = fit_histograms(seen, np.array([0, 0, 0, 1]), 3, bins=4)
    shares = np.exp(fitted.log(np.array([[0], [1], [2], [3]])))
    np.testing.assert_allclose(shares[:, 0], (np.array([2, 0, 1, 0]) + ADDED) / (3 + 4 * ADDED))
    # 5 is beyond the last bin and goes into it; so does whatever comes later
    np.testing.assert_allclose(shares[:, 1], (np.array([0, 0, 0, 1]) + ADDED) / (1 + 4 * ADDED))
    assert (fitted.log(np.array([[99]])) == fitted.log(np.array([[3]]))).all()
    # a class that nobody saw is even, and nothing is impossible
    np.testing.assert_allclose(shares[:, 2], 1 / 4)


def test_independent_columns_multiply() -> None:
    seen, labels = np.array([[0, 1], [1, 1], [1, 0]]), np.array([0, 0, 1])
    both = fit_histograms(seen, labels, 2, bins=3).log(seen)
    alone = sum(fit_histograms(seen[:, [k]], labels, 2, 3).log(seen[:, [k]]) for k in (0, 1))
    np.testing.assert_allclose(both, alone)


@settings(max_examples=8, deadline=None)
@given(COUNTS, st.permutations([0, 1, 2]))
def test_the_order_of_classes_does_not_matter(
    rows: list[tuple[int, ...]], order: list[int]
) -> None:
    table = np.array(rows)
    seen, labels = table[:, :3], table[:, 3]
    place = np.argsort(order)
    for fit, tolerance in (
        (lambda x, y: fit_histograms(x, y, 3, 7), 1e-12),
        (lambda x, y: fit_logistic(x, y, 3), 2e-3),
    ):
        straight = fit(seen, labels).log(seen)
        turned = fit(seen[:, order], place[labels]).log(seen[:, order])
        np.testing.assert_allclose(turned, straight[:, order], atol=tolerance)


def test_the_regression_finds_a_known_ratio_whatever_the_balance() -> None:
    # two normal classes, 2 apart with deviation 1: their log ratio is 2 x - 2, and one class has
    # twenty times the windows
    rng = np.random.default_rng(5)
    x = np.concatenate([rng.normal(0, 1, 40_000), rng.normal(2, 1, 2_000)])[:, None]
    labels = np.repeat([0, 1], [40_000, 2_000])
    log = fit_logistic(x, labels, 2).log(np.array([[0.0], [1.0], [2.0]]))
    np.testing.assert_allclose(log[:, 1] - log[:, 0], [-2, 0, 2], atol=0.15)


def test_nothing_learned_says_nothing() -> None:
    for fitted in (
        fit_logistic(np.empty((0, 3)), np.empty(0, int), 3),
        fit_histograms(np.empty((0, 3)), np.empty(0, int), 3, 4),
        fit_logistic(np.ones((5, 3)), np.array([0, 0, 1, 1, 2]), 3),
    ):
        log = fitted.log(np.array([[0, 0, 0], [3, 1, 2]]))
        np.testing.assert_allclose(log - log[:, :1], 0, atol=1e-9)


def test_wrong_input_is_named() -> None:
    with pytest.raises(ValueError, match="for"):
        fit_logistic(np.zeros((3, 2)), np.zeros(2, int), 3)
    with pytest.raises(ValueError, match="of 3 classes"):
        fit_histograms(np.zeros((2, 2)), np.array([0, 3]), 3, 4)
