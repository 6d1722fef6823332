"""Intervals of figures that are made of one value a trial: trials are drawn again.

A mean latency of a hundred trials is one draw of a hundred trials. The bootstrap (Efron 1979) asks
what other draws would have given; its percentiles are the interval. Of two sets of the same trials
the same ones are drawn in both, so that what the trials have in common drops out.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.stats import t as student

from analysis.nets.window_groups import DRAWS

FloatArray = npt.NDArray[np.float64]
Values = Sequence[float] | FloatArray

_SEED = 20_261
_QUANTILES = (0.025, 0.975)
_FEWEST = 2
"""Trials of which an interval can be told: one says nothing about the next."""

STATISTICS: Mapping[str, Callable[..., Any]] = {
    "mean": np.nanmean,
    "median": np.nanmedian,
    "p95": lambda values, axis: np.nanpercentile(values, 95, axis=axis),
}
"""What can be asked for, by name; each over an axis, trials without a value left out."""

_WHOLE: Mapping[str, Callable[..., Any]] = {
    "mean": np.mean,
    "median": np.median,
    "p95": lambda values, axis: np.percentile(values, 95, axis=axis),
}
"""The same where every trial has a value, some ten times as fast."""


def drawn(n: int, draws: int = DRAWS) -> npt.NDArray[np.int64]:
    """Which of n trials are drawn, (draws, n); the same ones at every call."""
    return np.random.Generator(np.random.PCG64(_SEED)).integers(0, n, (draws, n))


def interval(values: Values, statistic: str = "mean") -> tuple[float, float] | None:
    """The 95 % interval of a statistic over trials, percentiles; None with fewer than two trials.

    Args:
        values: (n,), one a trial.
        statistic: a name of `STATISTICS`.

    Raises:
        ValueError: a value that is not finite.
    """
    there = _checked(values)
    if not np.isfinite(there).all():
        raise ValueError("values must be finite")
    if len(there) < _FEWEST:
        return None
    return _span(_WHOLE[statistic](there[drawn(len(there))], axis=1))


def difference(
    first: Values, second: Values, statistic: str = "mean", *, paired: bool = False
) -> tuple[float, float] | None:
    """The 95 % interval of a statistic of `first` less that of `second`.

    Args:
        first, second: (n,) and (m,), one value a trial; NaN where a trial has none.
        paired: they are of the same trials in the same order, which are then drawn together.

    Returns:
        None where either has fewer than two values.

    Raises:
        ValueError: an infinite value, or paired sets of different lengths.
    """
    a, b = _checked(first), _checked(second)
    if paired and len(a) != len(b):
        raise ValueError(f"{len(a)} and {len(b)} values are no pairs")
    if min(np.isfinite(a).sum(), np.isfinite(b).sum()) < _FEWEST:
        return None
    of_a = drawn(len(a))
    of_b = of_a if paired else _others(len(b))
    whole = np.isfinite(a).all() and np.isfinite(b).all()
    measure = (_WHOLE if whole else STATISTICS)[statistic]
    with warnings.catch_warnings():  # a draw may hold only trials without a value
        warnings.simplefilter("ignore", RuntimeWarning)
        found = measure(a[of_a], axis=1) - measure(b[of_b], axis=1)
    return _span(found[np.isfinite(found)])


def share_difference(
    first: tuple[Values, Values], second: tuple[Values, Values]
) -> tuple[float, float] | None:
    """The 95 % interval of one share less another, over the same trials of several windows each.

    Args:
        first, second: hits and windows of each trial, (n,) and (n,), trials in the same order.

    Returns:
        None with fewer than two trials.

    Raises:
        ValueError: they are not of the same number of trials.
    """
    (a, of_a), (b, of_b) = ([_checked(part) for part in pair] for pair in (first, second))
    if len({len(a), len(of_a), len(b), len(of_b)}) > 1:
        raise ValueError("hits and windows must be of the same trials")
    if len(a) < _FEWEST:
        return None
    k = drawn(len(a))
    return _span(a[k].sum(axis=1) / of_a[k].sum(axis=1) - b[k].sum(axis=1) / of_b[k].sum(axis=1))


def _others(n: int) -> npt.NDArray[np.int64]:
    """Draws that have nothing to do with those of `drawn`."""
    return np.random.Generator(np.random.PCG64(_SEED + 1)).integers(0, n, (DRAWS, n))


def _checked(values: Values) -> FloatArray:
    there = np.asarray(values, np.float64)
    if there.ndim != 1 or np.isinf(there).any():
        raise ValueError("values must be (n,), none of them infinite")
    return there


def _span(found: FloatArray) -> tuple[float, float]:
    low, high = np.quantile(found, _QUANTILES)
    return float(low), float(high)


def between_seeds(first: Values, second: Values) -> float | None:
    """By how much two means over seeds may differ by chance, 95 %, Student's t.

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
