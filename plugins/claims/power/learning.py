"""Accuracy over the number of training trials, and its extrapolation to more.

The error of a classifier falls like a power of the number of training trials towards a floor that
more trials do not lower: ``floor + scale * n ** -exponent`` (Cortes et al. 1994, Learning curves:
asymptotic values and rate of convergence).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls

from sliplab.analysis.metrics.window_groups import strict_hits
from sliplab.analysis.networks.baselines import logistic_slices
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.plugins.claims.blocks import F64, I64
from sliplab.plugins.claims.power.document import Learning, LearningPoint
from sliplab.protocols.hashing import hash_integer

VERSION = 1
SHARES = (0.25, 0.5, 0.75, 1.0)
ORDERS = 3
"""Orders of the training trials of which shares are taken."""
EXPONENTS: F64 = np.linspace(0.1, 2.0, 20)
"""Tried ones: slower than the slowest cannot be distinguished from a higher floor."""
DRAWS = 400
LINE = 12
"""Points of the fit."""
_TAILS = (0.025, 0.975)
_SEED = 28


@dataclass(frozen=True)
class Curve:
    """A fit, as shares of windows."""

    floor: float
    scale: float
    exponent: float

    def error(self, trials: F64) -> F64:
        """Return the expected error, (n,)."""
        return self.floor + self.scale * trials**-self.exponent


def fit_curve(trials: F64, error: F64) -> Curve:
    """Fit a floor and a scale of at least 0 by least squares, for the exponent that fits best."""
    best: tuple[float, Curve] | None = None
    for exponent in EXPONENTS:
        columns = np.column_stack([np.ones(len(trials)), trials**-exponent])
        (floor, scale), off = nnls(columns, error)
        if best is None or off < best[0] - 1e-12:
            best = off, Curve(float(floor), float(scale), float(exponent))
    assert best is not None
    return best[1]


def share_of(train: SampleSet, share: float, order: int) -> tuple[int, SampleSet]:
    """Return how many training trials a share has, and their samples; smaller ones lie in larger.

    Args:
        order: number of the order in which trials are taken.
    """
    there = np.unique(train.trial)
    ranked = sorted(there, key=lambda k: hash_integer("learning", order, *train.trials[k]))
    chosen = ranked[: max(round(share * len(ranked)), 1)]
    rows = np.flatnonzero(np.isin(train.trial, chosen)).astype(np.int64)
    part = SampleSet(
        train.windows.take(rows),
        train.y[rows],
        train.trial[rows],
        train.start_ns[rows],
        train.trials,
    )
    return len(chosen), part


def logistic_accuracy(train: SampleSet, test: SampleSet) -> F64:
    """Train a logistic regression on cells and parts of the window; see `by_trial`."""
    votes, _ = logistic_slices(train.windows, train.y, test.windows)
    return by_trial(strict_hits(votes, test.y), test.trial)


def by_trial(hits: F64, trial: I64) -> F64:
    """Return the share of each trial's windows that are right, for trials with any."""
    count = np.bincount(trial)
    return np.asarray((np.bincount(trial, hits) / np.maximum(count, 1))[count > 0])


def learning_of(classifier: str, trials: F64, accuracy: F64, planned: int) -> Learning:
    """Return the curve, and the expected accuracy with all planned training trials.

    Its uncertainty is that of the test trials and of which training trials came first: both are
    resampled (a bootstrap), and the curve is fitted again.

    Args:
        trials: (s,) training trials. accuracy: (orders, s, test trials).
    """
    rng = np.random.default_rng(_SEED)
    orders, _, tested = accuracy.shape
    at = np.append(np.geomspace(trials[0], max(planned, trials[-1]), LINE), float(planned))
    means, lines = np.empty((DRAWS, len(trials))), np.empty((DRAWS, len(at)))
    for draw in range(DRAWS):
        chosen = accuracy[rng.integers(orders, size=orders)]
        means[draw] = chosen[:, :, rng.integers(tested, size=tested)].mean(axis=(0, 2))
        lines[draw] = 1.0 - fit_curve(trials, 1.0 - means[draw]).error(at)
    mean = accuracy.mean(axis=(0, 2))
    curve = fit_curve(trials, 1.0 - mean)
    line = _points(at, 1.0 - curve.error(at), lines)
    return Learning(
        classifier=classifier,
        test_trials=tested,
        points=_points(trials, mean, means),
        floor=curve.floor,
        scale=curve.scale,
        exponent=curve.exponent,
        planned=planned,
        expected=line[-1].accuracy,
        low=line[-1].low,
        high=line[-1].high,
        line=line[:-1],
    )


def _points(trials: F64, accuracy: F64, drawn: F64) -> tuple[LearningPoint, ...]:
    low, high = np.quantile(drawn, _TAILS, axis=0)
    return tuple(
        LearningPoint(trials=round(n), accuracy=float(a), low=float(b), high=float(c))
        for n, a, b, c in zip(trials, accuracy, low, high, strict=True)
    )
