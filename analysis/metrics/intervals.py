"""Confidence intervals of figures over trials, 95 %, valid for three trials as for a thousand.

The unit of variation is the trial, so trials are counted and not windows. A few trials give a poor
estimate of their own spread: bootstrapping six trials gives intervals that cover the truth in 86 of
100 cases. So means have Student's t, shares the same on log odds,
medians and percentiles the ranks of the values, and counts the exact binomial one. Of two sets of
the same trials each trial's difference is taken, so that what they have in common drops out.

Sources: Student 1908; Welch 1947; Korn and Graubard 1998 (shares of clusters, on log odds); Hutson
1999 (quantiles, by ranks between whole ones); Clopper and Pearson 1934; Garwood 1936 (counts in a
time); Efron 1979 (the bootstrap).
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import betainc, betaincinv, expit, gammaincinv, logit
from scipy.stats import t as student

FloatArray = npt.NDArray[np.float64]
Values = Sequence[float] | FloatArray
Span = tuple[float, float]

DRAWS = 2000
"""Bootstrap draws for a difference of medians or percentiles."""
_SEED = 20_261
_TAIL = 0.025
_QUANTILES = (_TAIL, 1 - _TAIL)
_FEWEST = 2
"""Fewest trials from which a spread can be estimated."""
_SHARES = {"median": 0.5, "p95": 0.95}
_FEWEST_DRAWN = {"median": 12, "p95": 72}
"""Trials from which on a difference that is drawn holds the truth often enough; the 95th percentile
of fewer has no upper bound at all, since the largest of them may lie below it."""

STATISTICS: Mapping[str, Callable[..., Any]] = {
    "mean": np.nanmean,
    "median": np.nanmedian,
    "p95": lambda values, axis: np.nanpercentile(values, 95, axis=axis),
}
"""Statistics by name; each over an axis, trials without a value left out."""


def interval(values: Values, statistic: str = "mean") -> Span | None:
    """The interval of a statistic over trials: Student's of a mean, by ranks of another.

    Args:
        values: (n,), one a trial.
        statistic: a name of `STATISTICS`.

    Returns:
        None where so few trials bound nothing: below 2, of a median 6, of a 95th percentile 72; and
        of a mean where all values are equal, so that nothing is known of their spread.

    Raises:
        ValueError: a value that is not finite.
    """
    there = _checked(values)
    if not np.isfinite(there).all():
        raise ValueError("values must be finite")
    if statistic != "mean":
        return _by_ranks(np.sort(there), _SHARES[statistic])
    return mean_interval(there, np.ones(len(there)))


def mean_interval(sums: Values, sizes: Values) -> Span | None:
    """Student's interval of the sum of `sums` over that of `sizes`, a mean over trials' windows.

    Args:
        sums, sizes: (n,) each, of the windows of a trial.

    Returns:
        None with fewer than two trials, or where none differs from another.
    """
    mean, parts = _ratio(_checked(sums), _checked(sizes))
    half = _half(parts)
    return None if not half else (mean - half, mean + half)


def share_interval(hits: Values, sizes: Values) -> Span | None:
    """The interval of a share of windows over trials, 0..1: Student's t on its log odds.

    Log odds keep it within 0..1 and let it reach farther to the side where there is room. Where no
    trial has a hit, or all have nothing else, it is the exact one of as many trials of one kind.

    Args:
        hits: (n,), a trial's windows that count, or the credit that they have.
        sizes: (n,), its windows.

    Returns:
        None with fewer than two trials, or where their shares are equal and neither 0 nor 1.
    """
    hits, sizes = _checked(hits), _checked(sizes)
    n = len(hits)
    if n < _FEWEST:
        return None
    share, parts = _ratio(hits, sizes)
    if not 0 < share < 1:
        return exact_interval(round(share) * n, n)
    half = _half(parts) / (share * (1 - share))
    if not half:
        return None
    middle = float(logit(share))
    return float(expit(middle - half)), float(expit(middle + half))


def exact_interval(count: int, trials: int) -> Span:
    """Clopper and Pearson's interval of the share of trials that a count is, 0..1.

    All of it without trials.
    """
    low = float(betaincinv(count, trials - count + 1, _TAIL)) if count > 0 else 0.0
    high = float(betaincinv(count + 1, trials - count, 1 - _TAIL)) if count < trials else 1.0
    return low, high


def poisson_interval(count: int) -> Span:
    """Garwood's exact interval of the expected number of events of which `count` were seen."""
    low = float(gammaincinv(count, _TAIL)) if count > 0 else 0.0
    return low, float(gammaincinv(count + 1, 1 - _TAIL))


def difference(
    first: Values, second: Values, statistic: str = "mean", *, paired: bool = False
) -> Span | None:
    """The interval of a statistic of `first` less that of `second`.

    Of means it is Welch's, or Student's over pairs; medians and percentiles are drawn again.

    Args:
        first, second: (n,) and (m,), one value a trial; NaN where a trial has none.
        paired: they are of the same trials in the same order.

    Returns:
        None where either has too few values: 2 for a mean, 12 for a median, 72 for the 95th
        percentile.

    Raises:
        ValueError: an infinite value, or paired sets of different lengths.
    """
    a, b = _checked(first), _checked(second)
    if paired and len(a) != len(b):
        raise ValueError(f"{len(a)} and {len(b)} values are no pairs")
    fewest = _FEWEST_DRAWN.get(statistic, _FEWEST)
    if min(np.isfinite(a).sum(), np.isfinite(b).sum()) < fewest:
        return None
    if statistic == "mean":
        return _mean_difference(a, b, paired=paired)
    of_a = drawn(len(a))
    of_b = of_a if paired else drawn(len(b), _SEED + 1)
    measure = STATISTICS[statistic]
    with warnings.catch_warnings():  # a draw may hold only trials without a value
        warnings.simplefilter("ignore", RuntimeWarning)
        found = measure(a[of_a], axis=1) - measure(b[of_b], axis=1)
    low, high = np.quantile(found[np.isfinite(found)], _QUANTILES)
    return float(low), float(high)


def share_difference(first: tuple[Values, Values], second: tuple[Values, Values]) -> Span | None:
    """Student's interval of one share less another, over the same trials of several windows each.

    Args:
        first, second: hits and windows of each trial, (n,) and (n,), trials in the same order.

    Returns:
        None with fewer than two trials.

    Raises:
        ValueError: they are not of the same number of trials.
    """
    pairs = [[_checked(part) for part in pair] for pair in (first, second)]
    if len({len(part) for pair in pairs for part in pair}) > 1:
        raise ValueError("hits and windows must be of the same trials")
    if len(pairs[0][0]) < _FEWEST:
        return None
    (a, of_a), (b, of_b) = (_ratio(hits, sizes) for hits, sizes in pairs)
    half = _half(of_a - of_b)
    return a - b - half, a - b + half


def between_seeds(first: Values, second: Values) -> float | None:
    """Return by how much two means over seeds may differ by chance, 95 %, Student's t.

    The spread of single seeds is pooled from the sets that have several; a set of one borrows it.

    Args:
        first, second: one value a seed.

    Returns:
        None where neither set has two seeds, or a set is empty.
    """
    sets = [_checked(first), _checked(second)]
    freedom = sum(len(values) - 1 for values in sets)
    if freedom < 1 or min(map(len, sets)) < 1:
        return None
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in sets)
    spread = np.sqrt(squares / freedom * sum(1 / len(values) for values in sets))
    return float(student.ppf(_QUANTILES[1], freedom) * spread)


def drawn(n: int, seed: int = _SEED) -> npt.NDArray[np.int64]:
    """Indices of the trials drawn out of n, int64 (DRAWS, n); the same at every call."""
    return np.random.Generator(np.random.PCG64(seed)).integers(0, n, (DRAWS, n))


def _ratio(sums: FloatArray, sizes: FloatArray) -> tuple[float, FloatArray]:
    """A sum over a sum, and what each trial moves it by, (n,): its variance is linear in these."""
    total = float(sizes.sum())
    if not total:
        return np.nan, np.empty(0)
    mean = float(sums.sum()) / total
    return mean, (sums - mean * sizes) / total


def _half(parts: FloatArray) -> float:
    """Half of Student's interval of a figure that n trials move by `parts`; 0 below two trials.

    What rounding leaves of trials that are all equal is not a spread.
    """
    n = len(parts)
    if n < _FEWEST or np.abs(parts).max() <= 1e-12 * max(1.0, float(np.abs(parts).sum())):
        return 0.0
    error = np.sqrt(n / (n - 1) * float((parts**2).sum()))
    return float(student.ppf(_QUANTILES[1], n - 1) * error)


def _mean_difference(a: FloatArray, b: FloatArray, *, paired: bool) -> Span:
    here, there = (np.isfinite(part) for part in (a, b))
    (mean_a, of_a), (mean_b, of_b) = (
        _ratio(np.where(known, part, 0.0), known.astype(np.float64))
        for part, known in ((a, here), (b, there))
    )
    gap = mean_a - mean_b
    if paired:
        half = _half((of_a - of_b)[here | there])
        return gap - half, gap + half
    # Welch: each set's squared error, and the degrees of freedom that fit their sum
    n, m = int(here.sum()), int(there.sum())
    squares = [float((of_a**2).sum()) * n / (n - 1), float((of_b**2).sum()) * m / (m - 1)]
    if not sum(squares):
        return gap, gap
    freedom = sum(squares) ** 2 / (squares[0] ** 2 / (n - 1) + squares[1] ** 2 / (m - 1))
    half = float(student.ppf(_QUANTILES[1], freedom) * np.sqrt(sum(squares)))
    return gap - half, gap + half


def _by_ranks(ordered: FloatArray, share: float) -> Span | None:
    """The interval of a quantile between two ranks, which need not be whole.

    The value of rank r of n lies below the quantile with the probability I(share; r, n + 1 - r).
    """
    n = len(ordered)

    def below(rank: float) -> float:
        return float(betainc(rank, n + 1 - rank, share))

    if n < _FEWEST or below(1) < 1 - _TAIL or below(n) > _TAIL:
        return None
    low, high = (brentq(lambda r, p=p: below(r) - p, 1, n) for p in (1 - _TAIL, _TAIL))
    places = np.arange(1, n + 1)
    return float(np.interp(low, places, ordered)), float(np.interp(high, places, ordered))


def _checked(values: Values) -> FloatArray:
    there = np.asarray(values, np.float64)
    if there.ndim != 1 or np.isinf(there).any():
        raise ValueError("values must be (n,), none of them infinite")
    return there
