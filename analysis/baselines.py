"""What little effort reaches on the same samples, so that the network's accuracy means something.

Event rate alone tells much about slip. The report prints these three beside the network: the
commonest class, two thresholds on the number of events, and a logistic regression on it. What the
network adds is what it has learned from space and time.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import log_softmax

from analysis.metrics import CLASSES, Labels, accuracy, check_labels

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
Samples = npt.NDArray[Any]

RIDGE = 1e-3
"""L2 penalty of the logistic regression on standardised weights, per mean log-likelihood."""


@dataclass(frozen=True)
class BaselineScore:
    """One baseline on the test samples.

    Attributes:
        name: ``majority``, ``rate_threshold`` or ``logistic``.
        argmax: accuracy in 0..1 by `analysis.metrics.accuracy` (ties are shared); None where
            there are no test samples.
        parameters: what was fitted, as plain data.
    """

    name: str
    argmax: float | None
    parameters: dict[str, Any]


def evaluate_baselines(
    train_x: Samples, train_y: Labels, test_x: Samples, test_y: Labels
) -> dict[str, BaselineScore]:
    """Fit the three baselines on the training samples and score them on the test samples.

    Args:
        train_x, test_x: event counts, (n, ...); only the total of each sample is used.
        train_y, test_y: classes, integer (n,), 0..2.

    Raises:
        ValueError: no training samples, lengths that differ, a label that is no class.
    """
    train_y, test_y = check_labels(train_y), check_labels(test_y)
    if len(train_x) != len(train_y) or len(test_x) != len(test_y):
        raise ValueError("samples and labels differ in number")
    if not len(train_y):
        raise ValueError("no training samples")
    train_total, test_total = window_totals(train_x), window_totals(test_x)
    each = np.bincount(train_y, minlength=len(CLASSES))
    low, high, table = fit_rate_thresholds(train_total, train_y)
    weights, mean, scale = fit_logistic(train_total, train_y)

    decisions: dict[str, tuple[npt.NDArray[Any], dict[str, Any]]] = {
        "majority": (
            np.tile(each, (len(test_y), 1)),
            {"training_samples": dict(zip(CLASSES, each.tolist(), strict=True))},
        ),
        "rate_threshold": (
            table[np.searchsorted([low, high], test_total)],
            {"thresholds_events": [low, high], "training_samples": table.tolist()},
        ),
        "logistic": (
            _scores(weights, _features(test_total, mean, scale)),
            {"weights": weights.tolist(), "mean": mean.tolist(), "scale": scale.tolist()},
        ),
    }
    return {
        name: BaselineScore(name, accuracy(votes, test_y).argmax, parameters)
        for name, (votes, parameters) in decisions.items()
    }


def window_totals(x: Samples) -> FloatArray:
    """Events of each sample, float64 (n,), from counts (n, ...)."""
    x = np.asarray(x)
    return x.reshape(len(x), -1).sum(axis=1, dtype=np.float64) if len(x) else np.empty(0)


def fit_rate_thresholds(totals: FloatArray, labels: IntArray) -> tuple[float, float, IntArray]:
    """Two thresholds on the total that get most training samples right, found exactly.

    They cut the totals into three intervals and each is called by its commonest class. With P_c
    the running number of samples of class c over the sorted distinct totals, and a, b, c the
    classes of the intervals, the best sum
    ``max over i <= j of (P_a - P_b)(i) + (P_b - P_c)(j) + P_c(end)`` is a running maximum in i:
    O(n log n) for the sort and linear after it. Among equals the smallest upper, then the
    smallest lower threshold is taken, which names no class.

    Args:
        totals: (n,), n at least 1.
        labels: integer (n,), 0..2.

    Returns:
        lower and upper threshold (half-way between neighbouring totals; half an event outside
        them at the ends), and int64 (3, 3): training samples by interval (row) and class; the
        largest of a row is its vote, equal ones share it.
    """
    values, where = np.unique(totals, return_inverse=True)
    classes = len(CLASSES)
    table = np.zeros((len(values) + 1, classes), np.int64)
    np.add.at(table, (where + 1, labels), 1)
    running = table.cumsum(axis=0)  # [i, c]: samples of class c among the i smallest values
    end = running[-1]

    # two[j]: most samples right with one threshold somewhere below cut j
    first = running[:, :, None] - running[:, None, :]
    two = (np.maximum.accumulate(first, axis=0) + running[:, None, :]).max(axis=(1, 2))
    j = int(np.argmax(two + (end - running).max(axis=1)))
    i = int(np.argmax(running[: j + 1].max(axis=1) + (running[j] - running[: j + 1]).max(axis=1)))

    edges = np.concatenate([[values[0] - 0.5], (values[1:] + values[:-1]) / 2, [values[-1] + 0.5]])
    parts = np.stack([running[i], running[j] - running[i], end - running[j]])
    # the lower intervals may be empty (the upper never is, at the smallest best cut): a total
    # below all those seen then votes with its neighbour
    for k in (1, 0):
        if not parts[k].any():
            parts[k] = parts[k + 1]
    return float(edges[i]), float(edges[j]), parts


def fit_logistic(totals: FloatArray, labels: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Multinomial logistic regression on the total and its log1p, by L-BFGS from zero.

    Minimises mean cross-entropy + `RIDGE` / 2 times the squared weights (not the offsets); the
    problem is convex and the start fixed, so the result repeats.

    Returns:
        weights (3, 3) with a row for the offset and one a feature; mean (2,) and scale (2,) of
        the features over the training samples.
    """
    raw = _raw_features(totals)
    mean, spread = raw.mean(axis=0), raw.std(axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    x = _features(totals, mean, scale)
    target = np.eye(len(CLASSES))[labels]
    shape = (x.shape[1], len(CLASSES))
    penalty = np.full(shape, RIDGE)
    penalty[0] = 0.0

    def objective(flat: FloatArray) -> tuple[float, FloatArray]:
        w = flat.reshape(shape)
        log_p = log_softmax(x @ w, axis=1)
        loss = -(target * log_p).sum() / len(x) + 0.5 * (penalty * w * w).sum()
        gradient = x.T @ (np.exp(log_p) - target) / len(x) + penalty * w
        return float(loss), gradient.ravel()

    found = minimize(objective, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B")
    return np.asarray(found.x).reshape(shape), mean, scale


def _raw_features(totals: FloatArray) -> FloatArray:
    return np.stack([totals, np.log1p(totals)], axis=1)


def _features(totals: FloatArray, mean: FloatArray, scale: FloatArray) -> FloatArray:
    scaled = (_raw_features(totals) - mean) / scale
    return np.concatenate([np.ones((len(totals), 1)), scaled], axis=1)


def _scores(weights: FloatArray, features: FloatArray) -> FloatArray:
    return np.asarray(features @ weights)
