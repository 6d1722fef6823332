"""Simple baselines on the same samples, as a reference for the network's accuracy.

Event rate alone is informative about slip. The report always compares three baselines with the
network: the majority class, two thresholds on the number of events, and a logistic regression on
it. They take a second. The positions of the events add information: a logistic regression on the
events of each cell, gradient boosting on the counts of cells and steps, and ordinary networks
(`networks.baseline_nets`) take minutes. All but the thresholds take any number of classes.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize
from scipy.special import log_softmax

from sliplab.analysis.metrics.classification import CLASSES, Labels, check_labels
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sparse import SparseWindows

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

RIDGE = 1e-3
"""L2 penalty of a logistic regression on standardised weights, per mean log-likelihood."""

SLICES = 10
"""Parts of a window for `logistic_slices`."""


def cheap_votes(
    train_x: SparseWindows,
    train_y: Labels,
    test_x: SparseWindows,
    classes: int = len(CLASSES),
) -> dict[str, npt.NDArray[Any]]:
    """Fit the cheap baselines on the training samples, and vote on the test samples.

    Two thresholds cut the totals into three parts, so they are there for three classes only.

    Args:
        train_x, test_x: event counts.
        train_y: classes, integer (n,), from 0.

    Returns:
        votes (n, classes) by ``majority``, ``rate_threshold`` and ``logistic``; of each test
        sample the highest is its class.

    Raises:
        ValueError: no training samples, lengths that differ, a label that is not a class.
    """
    train_y = check_labels(train_y, classes)
    if len(train_x) != len(train_y):
        raise ValueError("samples and labels differ in number")
    if not len(train_y):
        raise ValueError("no training samples")
    train_total, test_total = (x.totals.astype(np.float64) for x in (train_x, test_x))
    each = np.bincount(train_y, minlength=classes)
    votes: dict[str, npt.NDArray[Any]] = {"majority": np.tile(each, (len(test_x), 1))}
    if classes == len(CLASSES):
        low, high, table = fit_rate_thresholds(train_total, train_y)
        votes["rate_threshold"] = table[np.searchsorted([low, high], test_total)]
    rate = fit_logistic(_of_total(train_total), train_y, classes)
    votes["logistic"] = rate.scores(_of_total(test_total))
    return votes


def logistic_cells(
    train_x: SparseWindows, train_y: Labels, test_x: SparseWindows, classes: int = len(CLASSES)
) -> tuple[FloatArray, dict[str, Any]]:
    """Logistic regression on the log of 1 + each cell's events: where they are, not when.

    Returns:
        votes (n, classes) for the test samples, and what was fitted, without the weights.
    """
    return _logistic_of(cell_sums(train_x), train_y, cell_sums(test_x), classes)


def logistic_slices(
    train_x: SparseWindows,
    train_y: Labels,
    test_x: SparseWindows,
    classes: int = len(CLASSES),
    slices: int = SLICES,
) -> tuple[FloatArray, dict[str, Any]]:
    """The same on each cell's events in each of a few equal parts of the window.

    Args:
        slices: parts; a window of fewer steps has as many as steps.
    """
    train, test = (slice_sums(x, slices) for x in (train_x, test_x))
    votes, stated = _logistic_of(train, train_y, test, classes)
    return votes, {"slices": min(slices, train_x.shape[0]), **stated}


def _logistic_of(
    train: IntArray, labels: Labels, test: IntArray, classes: int
) -> tuple[FloatArray, dict[str, Any]]:
    fitted = fit_logistic(np.log1p(train), check_labels(labels, classes), classes)
    features = len(fitted.mean)
    stated = {
        "ridge": RIDGE,
        "weights": fitted.weights.size,
        "multiply_adds": features * classes,
        "iterations": fitted.iterations,
    }
    return fitted.scores(np.log1p(test)), stated


def slice_sums(x: SparseWindows, slices: int) -> IntArray:
    """Events of each cell in each part of a sample, int64 (n, slices * cells).

    Step t of T is in part ``t * slices // T``.
    """
    steps, places = x.shape[0], math.prod(x.shape[1:])
    slices = min(slices, steps)
    step = np.repeat(np.arange(len(x) * steps), np.diff(x.offsets))
    part = step // steps * slices + step % steps * slices // steps
    flat = np.bincount(part * places + x.cell, x.count, minlength=len(x) * slices * places)
    return flat.astype(np.int64).reshape(len(x), slices * places)


def cell_sums(x: SparseWindows) -> IntArray:
    """Events of each cell over all steps of a sample, int64 (n, channels * rows * columns)."""
    places = math.prod(x.shape[1:])
    sample = np.repeat(np.arange(len(x)), np.diff(x.offsets[:: x.shape[0]]))
    flat = np.bincount(sample * places + x.cell, x.count, minlength=len(x) * places)
    return flat.astype(np.int64).reshape(len(x), places)


def step_sums(x: SparseWindows) -> IntArray:
    """Events of each step over all cells of a sample, int64 (n, steps)."""
    running = np.concatenate([[0], x.count.cumsum(dtype=np.int64)])
    return np.diff(running[x.offsets]).reshape(len(x), x.shape[0])


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


@dataclass(frozen=True)
class Logistic:
    """A fitted multinomial logistic regression.

    Attributes:
        weights: (features + 1, classes), the first row is the offset.
        mean, scale: (features,), by which features are standardised.
        iterations: that it took.
    """

    weights: FloatArray
    mean: FloatArray
    scale: FloatArray
    iterations: int

    def scores(self, features: FloatArray) -> FloatArray:
        """Log-odds (n, classes) up to a constant a row."""
        return np.asarray(_standard(features, self.mean, self.scale) @ self.weights)


def fit_logistic(
    features: FloatArray,
    labels: IntArray,
    classes: int = len(CLASSES),
    *,
    balanced: bool = False,
) -> Logistic:
    """Multinomial logistic regression on standardised features, by L-BFGS from zero.

    Minimises mean cross-entropy + `RIDGE` / 2 times the squared weights (not the offsets); the
    problem is convex and the start fixed, so the result repeats.

    Args:
        features: (n, features), n at least 1.
        labels: integer (n,), 0..classes - 1.
        balanced: the mean is over the classes that have samples, of the means within each.
    """
    mean, spread = features.mean(axis=0), features.std(axis=0)
    scale = np.where(spread > 0, spread, 1.0)
    x = _standard(features, mean, scale)
    each = np.bincount(labels, minlength=classes)
    share, total = np.ones((len(x), 1)), float(len(x))
    if balanced:
        share, total = 1.0 / (each[labels] * (each > 0).sum())[:, None], 1.0
    target = np.eye(classes)[labels] * share
    shape = (x.shape[1], classes)
    penalty = np.full(shape, RIDGE)
    penalty[0] = 0.0

    def objective(flat: FloatArray) -> tuple[float, FloatArray]:
        w = flat.reshape(shape)
        log_p = log_softmax(x @ w, axis=1)
        loss = -(target * log_p).sum() / total + 0.5 * (penalty * w * w).sum()
        gradient = x.T @ (np.exp(log_p) * share - target) / total + penalty * w
        return float(loss), gradient.ravel()

    # sums over threads differ between numbers of them, and waiting costs the most
    with _one_thread():
        found = minimize(objective, np.zeros(shape).ravel(), jac=True, method="L-BFGS-B")
    return Logistic(np.asarray(found.x).reshape(shape), mean, scale, int(found.nit))


def _one_thread() -> AbstractContextManager[Any]:
    """Let libraries use one thread."""
    from threadpoolctl import threadpool_limits  # of an extra, which reading a store does not need

    limited: AbstractContextManager[Any] = threadpool_limits(1)
    return limited


def _of_total(totals: FloatArray) -> FloatArray:
    return np.stack([totals, np.log1p(totals)], axis=1)


def _standard(features: FloatArray, mean: FloatArray, scale: FloatArray) -> FloatArray:
    return np.concatenate([np.ones((len(features), 1)), (features - mean) / scale], axis=1)


ROUNDS = 100
"""Of boosting, at most; each grows a tree a class."""

PATIENCE = 10
"""Rounds without a better validation loss before it ends."""

_SEED = 0


def features(x: SparseWindows) -> npt.NDArray[np.float32]:
    """Events of each cell and of each step, float32 (n, cells + steps)."""
    return np.concatenate([cell_sums(x), step_sums(x)], axis=1).astype(np.float32)


def boosted(
    train: SampleSet,
    validation: SampleSet,
    test: SparseWindows,
    rounds: int = ROUNDS,
    classes: int = len(CLASSES),
) -> tuple[npt.NDArray[np.float64], dict[str, Any]]:
    """Fit as `fitted_trees`, and vote on test samples.

    Returns:
        probabilities (n, classes), and what was fitted as text and numbers.
    """
    model = fitted_trees(train, validation, rounds, classes)
    with _one_thread():
        votes = model.predict_proba(features(test)) if len(test) else np.empty((0, classes))
    return votes, {"rounds": int(model.n_iter_), "most_rounds": rounds, "patience": PATIENCE}


def fitted_trees(
    train: SampleSet,
    validation: SampleSet,
    rounds: int = ROUNDS,
    classes: int = len(CLASSES),
) -> Any:
    """Fit scikit-learn's gradient boosting on training samples, stop by validation samples.

    Returns:
        the classifier of `features`.

    Raises:
        ValueError: a class is missing among the training samples.
    """
    from sklearn.ensemble import HistGradientBoostingClassifier  # takes a second

    if set(np.unique(train.y).tolist()) != set(range(classes)):
        raise ValueError("gradient boosting needs training samples of every class")
    model = HistGradientBoostingClassifier(
        max_iter=rounds,
        early_stopping=True,
        n_iter_no_change=PATIENCE,
        random_state=_SEED,
    )
    # in one thread: its threads wait for each other busily, 30 times slower under other load
    with _one_thread():
        model.fit(
            features(train.windows),
            train.y,
            X_val=features(validation.windows),
            y_val=validation.y,
        )
    return model
