"""How likely what a window shows is without slip, in incipient and in gross slip.

Two models, both fitted on training trials alone. Histograms take the three spike counts for
independent given the state, which they are not; they say what counting alone reaches. The other is
a multinomial logistic regression on any features, turned into likelihoods by weighing the classes
equally: p(seen | state) is p(state | seen) times p(seen) where all states are equally common, and
p(seen) is the same for every state, so detectors never need it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import log_softmax

FloatArray = npt.NDArray[np.float64]
Array = npt.NDArray[np.integer] | FloatArray

ADDED = 0.5
"""Windows added to each bin of a histogram (Krichevsky and Trofimov, 1981): no bin stays empty."""

RIDGE = 1e-3
"""L2 penalty of the regression on standardised weights, per mean log likelihood."""


class Likelihood(Protocol):
    """What a window says about the state."""

    def log(self, features: Array) -> FloatArray:
        """Log likelihoods float64 (n, classes) of features (n, k), up to a constant a window."""


@dataclass(frozen=True)
class Histograms:
    """Independent histograms of small whole numbers.

    Attributes:
        table: float64 (k, classes, bins), log shares; a value beyond the last bin is of the last.
    """

    table: FloatArray

    def log(self, features: Array) -> FloatArray:
        """As `Likelihood.log`; features are whole numbers from 0."""
        bins = np.clip(np.asarray(features, np.int64), 0, self.table.shape[2] - 1)
        out = np.zeros((len(bins), self.table.shape[1]))
        for column, table in zip(bins.T, self.table, strict=True):
            out += table[:, column].T
        return out


def fit_histograms(
    features: Array, labels: npt.NDArray[np.integer], classes: int, bins: int
) -> Histograms:
    """Shares of each value by class, with `ADDED` windows in each bin.

    Args:
        features: whole numbers (n, k), 0 to ``bins - 1``; larger ones go into the last bin.
        labels: integer (n,), 0 to ``classes - 1``; a class without windows is taken as even.

    Raises:
        ValueError: lengths differ, or a label that is no class.
    """
    labels = _check(features, labels, classes)
    values = np.clip(np.asarray(features, np.int64), 0, bins - 1)
    table = np.empty((values.shape[1], classes, bins))
    for k, column in enumerate(values.T):
        counted = np.bincount(labels * bins + column, minlength=classes * bins)
        filled = counted.reshape(classes, bins) + ADDED
        table[k] = np.log(filled / filled.sum(axis=1, keepdims=True))
    return Histograms(table)


@dataclass(frozen=True)
class Logistic:
    """Multinomial logistic regression with all classes weighing the same.

    Attributes:
        weights: float64 (1 + k, classes), the first row the offsets.
        mean, scale: float64 (k,), of the features over the training windows.
    """

    weights: FloatArray
    mean: FloatArray
    scale: FloatArray

    def log(self, features: Array) -> FloatArray:
        """As `Likelihood.log`."""
        scaled = (np.asarray(features, np.float64) - self.mean) / self.scale
        # not a matrix product, whose rounding depends on how many windows there are: a detector
        # must say the same of a window whatever comes after it
        linear = np.broadcast_to(self.weights[0], (len(scaled), len(self.weights[0]))).copy()
        for column, weights in zip(scaled.T, self.weights[1:], strict=True):
            linear += column[:, None] * weights
        return np.asarray(log_softmax(linear, axis=1))


def fit_logistic(features: Array, labels: npt.NDArray[np.integer], classes: int) -> Logistic:
    """The regression, by L-BFGS from zero: convex, so the result repeats.

    Minimises the cross-entropy, averaged within each class that has windows and then over these,
    + `RIDGE` / 2 times the squared weights (not the offsets). It is blind to the classes' order.

    Args:
        features: (n, k), finite; a constant one gets no weight.
        labels: integer (n,), 0 to ``classes - 1``.

    Raises:
        ValueError: lengths differ, or a label that is no class.
    """
    labels = _check(features, labels, classes)
    raw = np.asarray(features, np.float64)
    if not len(raw):
        empty = np.zeros(raw.shape[1])
        return Logistic(np.zeros((1 + raw.shape[1], classes)), empty, empty + 1)
    mean, spread = raw.mean(axis=0), raw.std(axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    x = np.concatenate([np.ones((len(raw), 1)), (raw - mean) / scale], axis=1)
    each = np.bincount(labels, minlength=classes)
    share = 1.0 / (each[labels] * (each > 0).sum())
    target = np.eye(classes)[labels] * share[:, None]
    shape = (x.shape[1], classes)
    penalty = np.full(shape, RIDGE)
    penalty[0] = 0.0

    def objective(flat: FloatArray) -> tuple[float, FloatArray]:
        w = flat.reshape(shape)
        log_p = log_softmax(x @ w, axis=1)
        loss = -(target * log_p).sum() + 0.5 * (penalty * w * w).sum()
        gradient = x.T @ (np.exp(log_p) * share[:, None] - target) + penalty * w
        return float(loss), gradient.ravel()

    found = minimize(objective, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B")
    return Logistic(np.asarray(found.x).reshape(shape), mean, scale)


def _check(features: Array, labels: npt.NDArray[np.integer], classes: int) -> npt.NDArray[np.int64]:
    found = np.asarray(labels).astype(np.int64)
    if features.ndim != 2 or found.shape != features.shape[:1]:
        raise ValueError(f"features {features.shape} for {found.shape} labels")
    if len(found) and (found.min() < 0 or found.max() >= classes):
        raise ValueError(f"labels range over {found.min()}..{found.max()}; of {classes} classes")
    return found
