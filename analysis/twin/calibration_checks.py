"""Simulation-based calibration: are posteriors as wide as they should be?

The rank of the truth among samples of its posterior is uniform if worlds are drawn from the prior
and the posterior is right (Cook et al. 2006; Talts et al. 2018). Ranks at both ends say that
posteriors are too narrow, ranks in the middle that they are too wide, ranks at one end that they
are shifted. Uniformity is tested with bins (chi-square) and by the distribution function's largest
departure (simultaneous bands by simulation, Säilynoja et al. 2022).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.stats import binom, chi2

from sliplab.storage.streams import F64, I64

_POINTS = 50
_SIMULATED = 2000
_SEED = 20_270
_FEWEST_IN_BIN = 5


@dataclass(frozen=True)
class Uniformity:
    """Whether ranks are uniform.

    Attributes:
        bins: counts in bins of the same number of possible ranks, (b,).
        bins_p: probability of counts as uneven, if the ranks are uniform.
        at: shares of the possible ranks, (g,). below: share of ranks below these, (g,).
        low, high: where all of `below` lie in 95 of 100 cases, if the ranks are uniform, (g,).
        band_p: probability of a departure as improbable, if the ranks are uniform.
    """

    bins: I64
    bins_p: float
    at: F64
    below: F64
    low: F64
    high: F64
    band_p: float


def ranks(truths: F64, samples: F64) -> I64:
    """Return how many of m samples are below each truth, 0..m, (n, p).

    Args:
        truths: (n, p), of n worlds. samples: of their posteriors, (n, m, p).

    Raises:
        ValueError: the shapes do not fit.
    """
    if samples.ndim != 3 or truths.shape != (samples.shape[0], samples.shape[2]):
        raise ValueError(f"truths {truths.shape} do not fit samples {samples.shape}, (n, m, p)")
    return (samples < truths[:, None, :]).sum(axis=1).astype(np.int64)


def uniformity(found: I64, most: int) -> Uniformity:
    """Test whether ranks are uniform.

    Args:
        found: ranks of n worlds, 0..most, (n,).
        most: number of samples of a posterior.

    Raises:
        ValueError: no rank, or one outside 0..most.
    """
    n, possible = len(found), most + 1
    if n == 0 or most < 1 or found.min() < 0 or found.max() > most:
        raise ValueError(f"expected one or more ranks within 0..{most}, which is at least 0..1")
    count = max(min(n // _FEWEST_IN_BIN, possible, 20), 1)
    edges = np.round(np.linspace(0, possible, count + 1)).astype(np.int64)
    bins = np.histogram(found, edges - 0.5)[0].astype(np.int64)
    expected = n * np.diff(edges) / possible
    uneven = float(((bins - expected) ** 2 / expected).sum())
    cuts = _cuts(possible)
    at = cuts / possible
    null = _null(n, possible)
    count_below = _below(found[None], cuts)
    least = _least(count_below, n, at)[0]
    tail = float(np.quantile(null, 0.05)) / 2.0
    return Uniformity(
        bins, float(chi2.sf(uneven, count - 1)) if count > 1 else 1.0, at, count_below[0] / n,
        binom.ppf(tail, n, at) / n, binom.isf(tail, n, at) / n,
        float((1 + (null <= least).sum()) / (1 + _SIMULATED)),
    )  # fmt: skip


def _cuts(possible: int) -> I64:
    """Return numbers of ranks at which the distribution is looked at, each within 1..possible."""
    cuts = np.unique(np.round(np.linspace(0, possible, _POINTS + 2)[1:-1])).astype(np.int64)
    return cuts[(cuts > 0) & (cuts < possible)]


@lru_cache(maxsize=8)
def _null(n: int, possible: int) -> F64:
    """Return `_least` of simulated uniform ranks of n worlds."""
    cuts = _cuts(possible)
    drawn = np.random.default_rng(_SEED).integers(0, possible, (_SIMULATED, n))
    return _least(_below(drawn, cuts), n, cuts / possible)


def _below(found: I64, cuts: I64) -> I64:
    """Return how many of the ranks (r, n) are below each cut, (r, g)."""
    ordered = np.sort(found, axis=1)
    return np.array([np.searchsorted(row, cuts) for row in ordered], np.int64)


def _least(below: I64, n: int, at: F64) -> F64:
    """Return the least two-sided probability of the counts (r, g) over all cuts, (r,)."""
    both = np.minimum(binom.cdf(below, n, at), binom.sf(below - 1, n, at))
    result: F64 = 2.0 * both.min(axis=1)
    return result
