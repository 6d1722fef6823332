"""Confidence intervals of figures over trials, 95 %, valid for three trials as for a thousand.

The unit of variation is what was independent: the trial, or the world where several trials share
one. Windows of a trial, alarms of a trial and slides of a world are not counted. A few trials give
a poor estimate of their own spread: bootstrapping six trials gives intervals that cover the truth
in 86 of 100 cases. So means have Student's t, shares the same on log odds, medians and percentiles
the ranks of the values, counts of trials the exact binomial one and their differences a score
interval, rates of events a gamma distribution with the dispersion that is found between trials or
worlds, and medians over worlds the values at which Student's t accepts that half of each world's
values lie below. Of two sets of the same trials each trial's difference is taken, so that what they
have in common drops out.

Sources: Student 1908; Welch 1947; Korn and Graubard 1998 (shares of clusters, on log odds); Hutson
1999 (quantiles, by ranks between whole ones); Clopper and Pearson 1934; Garwood 1936 (counts in a
time); Newcombe 1998 (differences of shares of trials); McCullagh and Nelder 1989 (over-dispersed
counts); Satterthwaite 1946; Woodruff 1952 (medians of clusters, by the shares below); Efron 1979
(the bootstrap). How often they hold is measured by `benchmarks/interval_coverage.py`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.special import betainc, betaincinv, expit, gammaincinv, logit
from scipy.stats import norm
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
_FEWEST_CLUSTERS = 6
"""Fewest values that bound a median by their ranks, and clusters that do by Student's t."""
_JOINED = "of one cluster"
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


def interval(values: Values, statistic: str = "mean", least: float = -np.inf) -> Span | None:
    """The interval of a statistic over trials: Student's of a mean, by ranks of another.

    Args:
        values: (n,), one a trial; infinite ones have ranks and no mean.
        statistic: a name of `STATISTICS`.
        least: the smallest value that there can be: no finite end is below it.

    Returns:
        None where so few trials bound nothing: below 2, of a median 6, of a 95th percentile 72; and
        of a mean where all values are equal, so that nothing is known of their spread. An end is
        infinite where infinite values leave it open.

    Raises:
        ValueError: NaN, or an infinite value in a mean.
    """
    there = _checked(values, infinite=statistic != "mean")
    if np.isnan(there).any():
        raise ValueError("values must be finite")
    if statistic != "mean":
        span = _by_ranks(np.sort(there), _SHARES[statistic])
    else:
        span = mean_interval(there, np.ones(len(there)))
    if span is None:
        return None
    low, high = (end if np.isinf(end) else max(end, least) for end in span)
    return low, high


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


def rate_interval(
    counts: Values, exposures: Values, strata: Sequence[Hashable] | None = None
) -> Span | None:
    """The interval of events per unit of exposure, where events come in clusters.

    The variance of the sum is estimated between clusters (trials, or worlds) of the same stratum,
    not below that of a Poisson count. Its quotient with the sum scales a gamma interval, which is
    Garwood's exact one where clusters differ by no more than Poisson counts do. What exceeds
    Poisson is raised by 4 / clusters, and has Student's t, by Satterthwaite's degrees of freedom.

    In simulations (benchmarks/interval_coverage.py) it holds the rate in 93 to 97 % from 24
    clusters on, for clusters that are alike, of gamma rates of the shapes 1 and 0.3, and where 15 %
    have all events; and in 92 to 97 % from 8 clusters on where they are alike or of shape 1. With
    fewer clusters than 24 of shape 0.3 it holds in 88 to 93 %, with 16 of which 15 % have all
    events in 88 to 92 %: no interval can hold where hardly a cluster with events is seen. Below
    about 5 events it holds in 97 to 99 %, since counts are whole numbers. Without events nothing is
    known of the dispersion, and the upper end is Garwood's, 3.69 / exposure: right if events come
    one by one, and to be multiplied by their number if they come several in a cluster.

    Args:
        counts, exposures: (n,), a cluster's events and its time or the like, of any one unit.
        strata: (n,), which conditions of the design a cluster has; left out, all have the same. A
            repetition of the design has the same conditions, so differences between them are no
            chance. Strata of one cluster are joined.

    Returns:
        None with fewer than two clusters.
    """
    counts, exposures = _checked(counts), _checked(exposures)
    if len(counts) < _FEWEST:
        return None
    total, exposure = float(counts.sum()), float(exposures.sum())
    scale = 1.0
    if total > 0:
        variance, freedom = _sum_variance(counts, exposures, strata)
        excess = max(variance / total - 1, 0.0)
        if excess > 0:
            scale = 1 + excess * (1 + 4 / (freedom + 1))
            freedom *= (1 + 1 / excess) ** 2
            scale *= float(student.ppf(_QUANTILES[1], freedom) / norm.ppf(_QUANTILES[1])) ** 2
    events = total / scale
    low = scale * float(gammaincinv(events, _TAIL)) if total > 0 else 0.0
    return low / exposure, scale * float(gammaincinv(events + 1, 1 - _TAIL)) / exposure


def _sum_variance(
    counts: FloatArray, exposures: FloatArray, strata: Sequence[Hashable] | None
) -> tuple[float, float]:
    """Variance of a sum of counts within strata, and its degrees of freedom, 1 if there are none.

    Exposures may be unequal. A cluster that is compared with none has the variance of a Poisson
    count.
    """
    names = list(strata) if strata is not None else [None] * len(counts)
    seen = Counter(names)
    joined = [name if seen[name] > 1 else _JOINED for name in names]
    of: dict[Hashable, list[int]] = {}
    for place, name in enumerate(joined):
        of.setdefault(name, []).append(place)
    parts, alone = [], 0.0
    for places in of.values():
        n = len(places)
        here, time = counts[places], exposures[places]
        if n < _FEWEST:
            alone += float(here.sum())
            continue
        apart = here - time * float(here.sum()) / float(time.sum())
        parts.append((n / (n - 1) * float((apart**2).sum()), n - 1))
    variance = sum(part for part, _ in parts)
    squares = sum(part**2 / freedom for part, freedom in parts)
    return variance + alone, variance**2 / squares if squares else 1.0


def median_interval(values: Values, clusters: Sequence[Hashable]) -> Span | None:
    """The interval of the median of values that resemble each other within clusters.

    A value is in the interval if Student's t over the clusters accepts that half of all values lie
    below it. With one value a cluster it is that by ranks. In simulations
    (benchmarks/interval_coverage.py) it holds the median in 93 to 97 % from 6 clusters on, with
    none, a fifth or half of the variance between clusters.

    Args:
        values: (n,), infinite where an event never came.
        clusters: (n,), such as the world of each value.

    Returns:
        None with fewer than 6 clusters; an end is infinite where nothing bounds it.

    Raises:
        ValueError: NaN, or not as many clusters.
    """
    there = np.asarray(values, np.float64)
    if there.ndim != 1 or len(there) != len(clusters) or np.isnan(there).any():
        raise ValueError("values and clusters must be (n,), no value NaN")
    names = {name: place for place, name in enumerate(dict.fromkeys(clusters))}
    if len(names) < _FEWEST_CLUSTERS:
        return None
    order = np.argsort(there, kind="stable")
    ordered = there[order]
    if len(names) == len(ordered):
        return _by_ranks(ordered, _SHARES["median"])
    cluster = np.array([names[name] for name in clusters])[order]
    sizes = np.bincount(cluster)
    # how many more than half of a cluster's values lie below each of the n + 1 gaps
    one_more = np.zeros((len(ordered) + 1, len(sizes)))
    one_more[np.arange(1, len(ordered) + 1), cluster] = 1
    above_half = one_more.cumsum(axis=0) - sizes / 2
    error = above_half.std(axis=1, ddof=1) / np.sqrt(len(sizes))
    limit = student.ppf(_QUANTILES[1], len(sizes) - 1)
    accepted = np.flatnonzero(np.abs(above_half.mean(axis=1)) <= limit * error)
    edges = np.concatenate([[-np.inf], ordered, [np.inf]])
    return float(edges[accepted[0]]), float(edges[accepted[-1] + 1])


def difference(
    first: Values,
    second: Values,
    statistic: str = "mean",
    *,
    paired: bool = False,
    comparisons: int = 1,
) -> Span | None:
    """The interval of a statistic of `first` less that of `second`.

    Of means it is Welch's, or Student's over pairs; medians and percentiles are drawn again.

    Args:
        first, second: (n,) and (m,), one value a trial; NaN where a trial has none. Infinite ones
            have ranks and no mean.
        paired: they are of the same trials in the same order.
        comparisons: differences of means of which all intervals are to hold at once, in 95 %
            (Bonferroni).

    Returns:
        None where either has too few values: 2 for a mean, 12 for a median, 72 for the 95th
        percentile; of means where no trial differs from another; and where it is infinite.

    Raises:
        ValueError: an infinite value in a mean, or paired sets of different lengths.
    """
    a, b = (_checked(part, infinite=statistic != "mean") for part in (first, second))
    if paired and len(a) != len(b):
        raise ValueError(f"{len(a)} and {len(b)} values are no pairs")
    fewest = _FEWEST_DRAWN.get(statistic, _FEWEST)
    if min((~np.isnan(a)).sum(), (~np.isnan(b)).sum()) < fewest:
        return None
    if statistic == "mean":
        return _mean_difference(a, b, paired, _TAIL / comparisons)
    of_a = drawn(len(a))
    of_b = of_a if paired else drawn(len(b), _SEED + 1)
    measure = STATISTICS[statistic]
    with warnings.catch_warnings():  # a draw may hold only trials without a value
        warnings.simplefilter("ignore", RuntimeWarning)
        found = measure(a[of_a], axis=1) - measure(b[of_b], axis=1)
    # infinity less infinity may be anything; between two values a quantile of infinite ones is none
    finite = bool(np.isfinite(found).all())
    method: Literal["linear", "inverted_cdf"] = "linear" if finite else "inverted_cdf"
    low, high = (
        float(np.quantile(np.where(np.isnan(found), anything, found), tail, method=method))
        for tail, anything in zip(_QUANTILES, (-np.inf, np.inf), strict=True)
    )
    return (low, high) if np.isfinite([low, high]).all() else None


def count_difference(first: Values, second: Values, *, paired: bool = False) -> Span | None:
    """Newcombe's hybrid score interval of one share of trials less another, -1..1.

    Wilson's intervals of both shares, joined; of the same trials with the correlation that their
    table of four counts shows, lessened by its continuity correction (his method 10 of each paper).

    Args:
        first, second: (n,) and (m,), 1 for a trial that is counted, 0 for another.
        paired: they are of the same trials in the same order.

    Returns:
        None without a trial.

    Raises:
        ValueError: another value, or paired sets of different lengths.
    """
    a, b = _checked(first), _checked(second)
    if not np.isin(np.concatenate([a, b]), (0, 1)).all() or (paired and len(a) != len(b)):
        raise ValueError("trials must be counted as 0 or 1, of pairs as many in both sets")
    if not len(a) or not len(b):
        return None
    (p, low_a, high_a), (q, low_b, high_b) = _wilson(a), _wilson(b)
    phi = _phi(a, b) if paired else 0.0

    def reach(one: float, other: float) -> float:
        return float(np.sqrt(max(one**2 - 2 * phi * one * other + other**2, 0.0)))

    return p - q - reach(p - low_a, high_b - q), p - q + reach(high_a - p, q - low_b)


def _wilson(counted: FloatArray) -> tuple[float, float, float]:
    """A share of trials, and Wilson's interval of it."""
    n, z = len(counted), float(norm.ppf(_QUANTILES[1]))
    share = float(counted.mean())
    middle = (share + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z * np.sqrt(share * (1 - share) / n + z**2 / (4 * n**2)) / (1 + z**2 / n)
    return share, float(middle - half), float(middle + half)


def _phi(a: FloatArray, b: FloatArray) -> float:
    """The correlation of pairs of 0 and 1, lessened if it is positive; 0 where one is constant."""
    n = len(a)
    both, first, second, neither = (
        float(np.count_nonzero((a == x) & (b == y))) for x, y in ((1, 1), (1, 0), (0, 1), (0, 0))
    )
    margins = (both + first) * (second + neither) * (both + second) * (first + neither)
    if not margins:
        return 0.0
    apart = both * neither - first * second
    return (max(apart - n / 2, 0.0) if apart > 0 else apart) / float(np.sqrt(margins))


def share_difference(first: tuple[Values, Values], second: tuple[Values, Values]) -> Span | None:
    """Student's interval of one share less another, over the same trials of several windows each.

    Args:
        first, second: hits and windows of each trial, (n,) and (n,), trials in the same order.

    Returns:
        None with fewer than two trials, or where none differs from another.

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
    return (a - b - half, a - b + half) if half else None


def between_seeds(first: Values, second: Values) -> float | None:
    """Return by how much two means over seeds may differ by chance, 95 %, Student's t.

    The spread of single seeds is pooled from the sets that have several; a set of one borrows it.

    Args:
        first, second: one value a seed.

    Returns:
        None where neither set has two seeds, a set is empty, or no seed differs from another.
    """
    sets = [_checked(first), _checked(second)]
    freedom = sum(len(values) - 1 for values in sets)
    if freedom < 1 or min(map(len, sets)) < 1:
        return None
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in sets)
    if squares <= 1e-24 * max(float((values**2).sum()) for values in sets):
        return None
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


def _half(parts: FloatArray, tail: float = _TAIL) -> float:
    """Half of Student's interval of a figure that n trials move by `parts`; 0 below two trials.

    What rounding leaves of trials that are all equal is not a spread.
    """
    n = len(parts)
    if n < _FEWEST or np.abs(parts).max() <= 1e-12 * max(1.0, float(np.abs(parts).sum())):
        return 0.0
    error = np.sqrt(n / (n - 1) * float((parts**2).sum()))
    return float(student.ppf(1 - tail, n - 1) * error)


def _mean_difference(a: FloatArray, b: FloatArray, paired: bool, tail: float) -> Span | None:
    here, there = (np.isfinite(part) for part in (a, b))
    (mean_a, of_a), (mean_b, of_b) = (
        _ratio(np.where(known, part, 0.0), known.astype(np.float64))
        for part, known in ((a, here), (b, there))
    )
    gap = mean_a - mean_b
    if paired:
        half = _half((of_a - of_b)[here | there], tail)
        return (gap - half, gap + half) if half else None
    # Welch: each set's squared error, and the degrees of freedom that fit their sum
    n, m = int(here.sum()), int(there.sum())
    squares = [float((of_a**2).sum()) * n / (n - 1), float((of_b**2).sum()) * m / (m - 1)]
    if not (_half(of_a) or _half(of_b)):
        return None
    freedom = sum(squares) ** 2 / (squares[0] ** 2 / (n - 1) + squares[1] ** 2 / (m - 1))
    half = float(student.ppf(1 - tail, freedom) * np.sqrt(sum(squares)))
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
    return _at_rank(low, ordered), _at_rank(high, ordered)


def _at_rank(rank: float, ordered: FloatArray) -> float:
    """The value at a rank from 1 on, between its neighbours; infinite where the next one is."""
    place = int(rank) - 1
    part = rank - 1 - place
    if not part or np.isinf(ordered[place]):
        return float(ordered[place])
    return float(ordered[place] + part * (ordered[place + 1] - ordered[place]))


def _checked(values: Values, *, infinite: bool = False) -> FloatArray:
    there = np.asarray(values, np.float64)
    if there.ndim != 1 or (not infinite and np.isinf(there).any()):
        raise ValueError("values must be (n,), none of them infinite")
    return there
