"""Intervals of figures that are made of one value a trial: trials are drawn again.

A mean latency of a hundred trials is one draw of a hundred trials. The bootstrap (Efron 1979) asks
what other draws would have given; its percentiles are the interval. Of two sets of the same trials
the same ones are drawn in both, so that what the trials have in common drops out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.window_groups import DRAWS

FloatArray = npt.NDArray[np.float64]
Values = Sequence[float] | FloatArray

_SEED = 20_261
_QUANTILES = (0.025, 0.975)
_FEWEST = 2
"""Trials of which an interval can be told: one says nothing about the next."""

STATISTICS: Mapping[str, Callable[..., Any]] = {
    "mean": np.mean,
    "median": np.median,
    "p95": lambda values, axis: np.percentile(values, 95, axis=axis),
    "min": np.min,
}
"""What can be asked for, by name; each over an axis."""


def drawn(n: int, draws: int = DRAWS) -> npt.NDArray[np.int64]:
    """Which of n trials are drawn, (draws, n); the same ones at every call."""
    return np.random.Generator(np.random.PCG64(_SEED)).integers(0, n, (draws, n))


def interval(values: Values, statistic: str = "mean") -> tuple[float, float] | None:
    """The 95 % interval of a statistic over trials, percentiles; None with fewer than two trials.

    Args:
        values: (n,), one a trial.
        statistic: a name of `STATISTICS`. A minimum has no sensible interval this way.

    Raises:
        ValueError: a value that is not finite.
    """
    there = _checked(values)
    if len(there) < _FEWEST:
        return None
    return _span(STATISTICS[statistic](there[drawn(len(there))], axis=1))


def difference(
    first: Values, second: Values, statistic: str = "mean", *, paired: bool = False
) -> tuple[float, float] | None:
    """The 95 % interval of a statistic of `first` less that of `second`.

    Args:
        first, second: (n,) and (m,), one value a trial.
        paired: they are of the same trials in the same order, which are then drawn together.

    Raises:
        ValueError: a value that is not finite, or paired sets of different lengths.
    """
    a, b = _checked(first), _checked(second)
    if paired and len(a) != len(b):
        raise ValueError(f"{len(a)} and {len(b)} values are no pairs")
    if min(len(a), len(b)) < _FEWEST:
        return None
    of_a = drawn(len(a))
    of_b = of_a if paired else _others(len(b))
    measure = STATISTICS[statistic]
    return _span(measure(a[of_a], axis=1) - measure(b[of_b], axis=1))


def _others(n: int) -> npt.NDArray[np.int64]:
    """Draws that have nothing to do with those of `drawn`."""
    return np.random.Generator(np.random.PCG64(_SEED + 1)).integers(0, n, (DRAWS, n))


def _checked(values: Values) -> FloatArray:
    there = np.asarray(values, np.float64)
    if there.ndim != 1 or not np.isfinite(there).all():
        raise ValueError("values must be (n,) and finite")
    return there


def _span(found: FloatArray) -> tuple[float, float]:
    low, high = np.quantile(found, _QUANTILES)
    return float(low), float(high)
