"""Intervals that hold however often they are looked at: confidence sequences by betting.

Somebody bets against a value m that the mean might have. Each bet multiplies the capital by
``1 + b (z - m)``, which is 1 on average if m is the mean, so that the capital ever reaches
1 / error with a chance of at most `error` (Ville's inequality): m is refuted there, at any look.
The stakes ``b`` are a few fixed shares of the largest that cannot lose all, and the capital is the
mean over them, so nothing is tuned by the data (Waudby-Smith and Ramdas 2024, Estimating means of
bounded random variables by betting).

Values of one round need not have the same expectation, as those of a block of conditions have not:
if their mean over the round is m, the product of their expectations is at most 1, since a geometric
mean is at most the arithmetic one. So the capital is looked at where rounds end.

A percentile is the value below which a share p of the figures lies, so that bets are on the share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

F64 = npt.NDArray[np.float64]
STAKES: F64 = np.geomspace(0.03, 0.95, 6)
_STEPS = 50
"""Halvings: far below what a figure is printed to."""


@dataclass(frozen=True)
class Bets:
    """What is bet on, trial by trial.

    Attributes:
        z: (n,) unbiased estimates of the mean, given all that came before.
        low, high: (n,) bounds of each, known before it.
        looks: (k,) int, how many of them there are at the end of each round, ascending.
    """

    z: F64
    low: F64
    high: F64
    looks: npt.NDArray[np.int64]

    @staticmethod
    def of(z: F64, looks: npt.NDArray[np.int64]) -> Bets:
        """Return bets on values from 0 to 1 themselves."""
        return Bets(z, np.zeros(len(z)), np.ones(len(z)), looks)


def capital(bets: Bets, mean: float, *, above: bool) -> F64:
    """Return the logarithm of the capital at each look.

    Args:
        mean: that is bet against. above: the bet is that the true mean is above it, else below.

    Returns:
        (k,) float64.
    """
    gain = bets.z - mean if above else mean - bets.z
    room = mean - bets.low if above else bets.high - mean
    if not len(bets.z):
        return np.zeros(len(bets.looks))
    share = gain / np.maximum(room, 1e-12)  # of a stake, at least -1
    grown = np.cumsum(np.log1p(STAKES[:, None] * np.maximum(share, -1.0)), axis=1)
    at_looks = np.where(bets.looks > 0, grown[:, np.maximum(bets.looks - 1, 0)], 0.0)
    return np.asarray(np.logaddexp.reduce(at_looks, axis=0) - np.log(len(STAKES)))


def refuted(bets: Bets, mean: float, error: float, *, above: bool) -> bool:
    """Return whether a mean was refuted at some look: the true one is above it, or below."""
    return bool((capital(bets, mean, above=above) >= -np.log(error)).any())


def mean_bounds(bets: Bets, error: float) -> tuple[float, float]:
    """Return bounds of a mean between 0 and 1, each of which is wrong with `error` at most."""
    low, high = 0.0, 1.0
    if refuted(bets, 0.0, error, above=True):
        low = _border(lambda m: refuted(bets, m, error, above=True), 0.0, 1.0)
    if refuted(bets, 1.0, error, above=False):
        high = _border(lambda m: refuted(bets, m, error, above=False), 1.0, 0.0)
    return low, high


def _border(wrong: object, inside: float, outside: float) -> float:
    """Return where values stop being wrong, by halving."""
    assert callable(wrong)
    for _ in range(_STEPS):
        middle = 0.5 * (inside + outside)
        if wrong(middle):
            inside = middle
        else:
            outside = middle
    return inside
