"""Bounds that hold at every look: against exact chances, for values of any kind."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sliplab.analysis.claims.sequences import STAKES, Bets, capital, mean_bounds, refuted

EACH = 200


def looked_at(z: np.ndarray, every: int = 1) -> Bets:
    """Bets on values from 0 to 1 that are looked at after so many each."""
    return Bets.of(z, np.arange(every, len(z) + 1, every, dtype=np.int64))


@pytest.mark.parametrize("above", [True, False])
@pytest.mark.parametrize("share", [0.05, 0.5, 0.9])
def test_a_true_mean_is_refuted_as_seldom_as_stated_by_exact_enumeration(
    share: float, above: bool
) -> None:
    # every sequence of 12 throws with its exact chance: the capital reaches 1 / error at some look
    error, n = 0.2, 12
    chance = 0.0
    for throws in itertools.product((0.0, 1.0), repeat=n):
        if refuted(looked_at(np.array(throws)), share, error, above=above):
            hits = sum(throws)
            chance += share**hits * (1 - share) ** (n - hits)
    assert chance <= error


@pytest.mark.parametrize("above", [True, False])
def test_the_capital_is_fair_on_average(above: bool) -> None:
    # by enumeration: the mean capital of a fair bet stays 1 at each look
    share, n = 0.3, 10
    mean = np.zeros(n)
    for throws in itertools.product((0.0, 1.0), repeat=n):
        hits = sum(throws)
        weight = share**hits * (1 - share) ** (n - hits)
        mean += weight * np.exp(capital(looked_at(np.array(throws)), share, above=above))
    assert mean == pytest.approx(np.ones(n), rel=1e-9)


def test_conditions_of_a_block_may_differ_as_they_like() -> None:
    # half of each block never hits, half always: the mean is known exactly, and never refuted
    block = np.array([0.0, 1.0] * 10)
    bets = looked_at(np.tile(block, 30), len(block))
    assert not refuted(bets, 0.5, 0.05, above=True)
    assert not refuted(bets, 0.5, 0.05, above=False)
    # looked at inside a block, where all ones come first, it would be
    inside = looked_at(np.tile(np.sort(block)[::-1], 30), 1)
    assert refuted(inside, 0.5, 0.05, above=True)


def test_no_failure_among_many_is_called_after_the_number_that_the_stakes_give() -> None:
    # a bet of stake k wins log1p(k p / (1 - p)) on each trial without a failure
    p, error = 0.05, 0.05
    wins = np.log1p(STAKES * p / (1 - p))
    trials = np.arange(1, 400)
    grown = np.log(np.exp(np.outer(trials, wins)).mean(axis=1))
    first = int(trials[np.argmax(grown >= -math.log(error))])
    bets = looked_at(np.zeros(first))
    assert refuted(bets, p, error, above=False)
    assert not refuted(looked_at(np.zeros(first - 1)), p, error, above=False)
    # a single look at a fixed number needs 59 (0.95 ** 59 < 0.05)
    assert 59 <= first <= 2 * 59


@given(st.lists(st.floats(0, 1), min_size=1, max_size=40), st.integers(1, 7))
def test_bounds_hold_the_mean_or_say_nothing(values: list[float], every: int) -> None:
    z = np.array(values)
    low, high = mean_bounds(looked_at(z, every), 0.01)
    assert 0.0 <= low <= high <= 1.0
    seen = z[: len(z) // every * every]
    if len(seen):
        assert low <= seen.max() + 1e-9
        assert high >= seen.min() - 1e-9
    else:
        assert (low, high) == (0.0, 1.0)


def test_values_that_are_all_at_an_end_are_no_fault() -> None:
    for value in (0.0, 1.0):
        low, high = mean_bounds(looked_at(np.full(EACH, value)), 0.05)
        assert low <= value <= high
        assert high - low < 0.05


def test_bounds_shrink_with_the_scatter_of_the_values() -> None:
    rng = np.random.default_rng(3)
    wide = rng.random(800)
    narrow = 0.5 + 0.1 * (wide - 0.5)
    spans = [np.diff(mean_bounds(looked_at(z, 100), 0.05))[0] for z in (wide, narrow)]
    assert spans[1] < 0.4 * spans[0]
    # a Student interval at one look is 1.96 s / sqrt(n) each way; many looks cost less than 2.5
    assert spans[0] < 2.5 * 2 * 1.96 * wide.std() / math.sqrt(len(wide))
