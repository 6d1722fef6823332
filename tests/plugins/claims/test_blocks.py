"""Means from blocks: closed forms, and rates of error where blocks differ, drift and are skewed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.stats import norm, t

from sliplab.plugins.claims.blocks import MeanEstimate, block_share, of_trials

F = Callable[[np.random.Generator], np.ndarray]
CASES: dict[str, F] = {
    "independent": lambda rng: rng.normal(0.5, 0.1, 24),
    "correlated by 0.3": lambda rng: 0.5 + 0.1 * _autoregressive(rng, 24, 0.3),
    "with a drift of four deviations": lambda rng: (
        rng.normal(0.5, 0.1, 24) + np.linspace(-0.2, 0.2, 24)
    ),
    "skewed as exponential": lambda rng: 0.4 + 0.1 * rng.exponential(size=24),
    "skewed the other way": lambda rng: 0.6 - 0.1 * rng.exponential(size=24),
}


def _autoregressive(rng: np.random.Generator, count: int, rho: float) -> np.ndarray:
    found = [rng.normal()]
    for _ in range(count - 1):
        found.append(rho * found[-1] + np.sqrt(1 - rho**2) * rng.normal())
    return np.array(found)


def of(blocks: np.ndarray) -> MeanEstimate:
    """The estimate that is the mean of blocks."""
    count = len(blocks)
    return of_trials(
        float(blocks.mean()), blocks, np.full(count, 1 / count), np.arange(count), count
    )


@pytest.mark.quick(4)
@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("above", [True, False])
def test_a_true_mean_is_seldom_called_wrong(case: str, above: bool) -> None:
    rng, runs = np.random.default_rng(3), 3000
    limit = norm.isf(0.05)
    wrong = sum(of(CASES[case](rng)).evidence(0.5, above=above) > limit for _ in range(runs))
    # of a t interval without corrections: up to 0.16
    assert wrong / runs < (0.08 if "correlated" in case else 0.065)


def test_a_straight_trend_does_not_widen_the_error() -> None:
    noise = np.random.default_rng(1).normal(0.5, 0.1, 30)
    drift = 0.02 * np.arange(30)
    assert of(noise + drift).standard_error == pytest.approx(of(noise).standard_error)
    assert of(drift).standard_error == 0.0


def test_the_statistic_of_symmetric_uncorrelated_blocks_is_students() -> None:
    pattern = np.array([1.0, -1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0])  # no trend, no skewness
    found = of(0.5 + 0.1 * pattern)
    rest = 0.1 * pattern
    near = max(rest[1:] @ rest[:-1] / (rest @ rest) + 2 / 8, 0.0)
    error = np.sqrt(rest @ rest / 6 / 8 * (1 + near) / (1 - near))
    assert found.standard_error == pytest.approx(error)
    expected = norm.isf(t.sf(0.05 / error, 6))
    assert found.evidence(0.45, above=True) == pytest.approx(expected)


def test_equal_blocks_are_bounded_by_their_number() -> None:
    none = of(np.zeros(60))
    assert norm.sf(none.evidence(0.05, above=False)) == pytest.approx(0.95**60)
    assert none.evidence(0.05, above=True) == -np.inf
    all_ = of(np.full(10, 0.9))
    assert norm.sf(all_.evidence(0.6, above=True)) == pytest.approx((0.6 / 0.9) ** 10)


def test_few_blocks_call_nothing() -> None:
    assert of(np.array([0.1, 0.1, 0.11, 0.1, 0.1])).evidence(0.9, above=False) == -np.inf


def test_a_difference_cancels_what_blocks_share() -> None:
    shared = np.random.default_rng(2).normal(0, 0.3, 12)
    own = np.linspace(-0.01, 0.01, 12) ** 2 * 50
    first, second = of(0.4 + shared), of(0.5 + shared + own)
    found = second.minus(first)
    assert found.value == pytest.approx(0.1 + own.mean())
    assert found.standard_error < 0.1 * first.standard_error


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5])
def test_the_share_of_blocks_in_the_variance_is_found(share: float) -> None:
    rng = np.random.default_rng(5)
    blocks = np.repeat(np.arange(400), 12)
    off = np.sqrt(share) * rng.normal(size=400)[blocks] + np.sqrt(1 - share) * rng.normal(size=4800)
    off[::50] = np.nan
    assert block_share(off, blocks)[0] == pytest.approx(share, abs=0.05)
