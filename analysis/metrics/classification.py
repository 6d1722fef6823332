"""Accuracy and confusion of spike counts, by measures that a silent network cannot flatter.

The class of a sample is the one whose output neurons spike most. A network that never fires gives
(0, 0, 0) everywhere; an ordinary argmax calls that class 0 and looks good on a quiet recording.
So a tie is shared here, accuracies with a unique winner and with a margin are also given, and
nothing depends on the order of the classes. There are as many classes as columns of counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
import numpy.typing as npt

from sliplab.storage.schema.evaluation import Accuracy, Classification

CLASSES = ("no_slip", "incipient", "gross")
"""Names of the classes of slip; their positions are the labels 0, 1, 2 and the columns of spike
counts."""

NO_SLIP, INCIPIENT, GROSS = range(3)

Counts = npt.NDArray[Any]
Labels = npt.NDArray[np.integer[Any]]
IntArray = npt.NDArray[np.int64]


def check(counts: Counts, labels: Labels) -> tuple[Counts, IntArray]:
    """Counts (n, K) and labels (n,) in 0..K-1, or a ValueError that says what is wrong."""
    counts, labels = np.asarray(counts), np.asarray(labels)
    if counts.ndim != 2 or counts.shape[1] < 2:
        raise ValueError(f"counts have the shape {counts.shape}; expected (n, 2 or more classes)")
    if labels.shape != counts.shape[:1]:
        raise ValueError(f"{labels.shape} labels for {counts.shape[0]} rows of counts")
    if counts.size and not np.isfinite(counts).all():
        raise ValueError("counts hold a value that is not finite")
    return counts, check_labels(labels, counts.shape[1])


def check_labels(labels: Labels, classes: int = len(CLASSES)) -> IntArray:
    """Labels as int64, or a ValueError if one is not among so many classes."""
    labels = np.asarray(labels)
    if labels.ndim != 1 or (labels.size and not np.issubdtype(labels.dtype, np.integer)):
        raise ValueError(f"labels are {labels.dtype} {labels.shape}; expected integers (n,)")
    if labels.size and (labels.min() < 0 or labels.max() >= classes):
        raise ValueError(
            f"labels range over {labels.min()}..{labels.max()}; expected 0..{classes - 1}"
        )
    return labels.astype(np.int64)


def winners(counts: Counts, margin: float = 0.0) -> npt.NDArray[Any]:
    """The class that leads every other by at least `margin`, (n,); -1 where there is none.

    A tie has no winner even where `margin` is 0. Labels are int8, or int16 over 127 classes.
    """
    counts = np.asarray(counts)
    kind = np.int8 if counts.ndim < 2 or counts.shape[1] <= np.iinfo(np.int8).max else np.int16
    if not len(counts):
        return np.empty(0, kind)
    ordered = np.sort(counts, axis=1)
    lead = ordered[:, -1] - ordered[:, -2]
    decided = (lead > 0) & (lead >= margin)
    return np.where(decided, counts.argmax(axis=1), -1).astype(kind)


def accuracy(counts: Counts, labels: Labels, margin: float = 0.0) -> Accuracy:
    """The three accuracies of spike counts (n, K) against labels int (n,).

    Without a `margin` any lead decides, as in the strict one.
    """
    counts, labels = check(counts, labels)
    n = len(labels)
    if n == 0:
        return Accuracy(argmax=None, strict=None, margin=None, n=0)
    top = _best(counts)
    hit = top[np.arange(n), labels]
    # as fractions, so that the sum is exact in any order
    ties = np.bincount(top.sum(axis=1)[hit]).tolist()
    shared = sum((Fraction(many, k) for k, many in enumerate(ties) if many), Fraction())
    return Accuracy(
        argmax=float(shared / n),
        strict=int((winners(counts) == labels).sum()) / n,
        margin=int((winners(counts, margin) == labels).sum()) / n,
        n=n,
    )


def credit(scores: Counts, labels: Labels) -> npt.NDArray[np.float64]:
    """Score of each window for argmax accuracy: 1, 1/k where k classes tie, or 0; (n,)."""
    scores, labels = check(scores, labels)
    top = _best(scores)
    return np.asarray(top[np.arange(len(labels)), labels] / np.maximum(top.sum(axis=1), 1))


def _best(scores: Counts) -> npt.NDArray[np.bool_]:
    """Return where each window has its highest score, (n, K); all classes that tie for it."""
    return np.asarray(scores == scores.max(axis=1, keepdims=True))


def confusion(counts: Counts, labels: Labels) -> IntArray:
    """Confusion matrix: true class by row, called class by column, int64 (K, K + 1).

    The last column is 'undecided': no unique winner. Rows add up to the samples of the class.
    """
    counts, labels = check(counts, labels)
    classes = counts.shape[1]
    columns = classes + 1
    found = winners(counts).astype(np.int64)
    found[found < 0] = columns - 1
    cells = np.bincount(labels * columns + found, minlength=classes * columns)
    return cells.reshape(classes, columns).astype(np.int64)


def class_balance(labels: Labels, names: Sequence[str] = CLASSES) -> dict[str, float | None]:
    """Share of each class among the labels; None if there are no labels."""
    labels = check_labels(labels, len(names))
    each = np.bincount(labels, minlength=len(names))
    return {name: _share(each[k], len(labels)) for k, name in enumerate(names)}


def score(
    counts: Counts, labels: Labels, margin: float = 0.0, names: Sequence[str] = CLASSES
) -> Classification:
    """Accuracies, confusion matrix, precision, recall and class balance in one.

    Args:
        counts: spike counts (n, K), integer or float.
        labels: true classes, integer (n,), 0..K-1.
        margin: spikes by which a winner must lead for the margin accuracy; any lead by default.
        names: of the K classes.

    Raises:
        ValueError: shapes that do not fit, a label that is not a class, a count not finite.
    """
    counts = np.asarray(counts)
    if counts.ndim != 2 or counts.shape[1] != len(names):
        raise ValueError(f"counts have the shape {counts.shape}; expected (n, {len(names)})")
    table = confusion(counts, labels)
    return Classification(
        accuracy=accuracy(counts, labels, margin),
        confusion=tuple(map(tuple, table.tolist())),
        precision={n: _share(table[k, k], table[:, k].sum()) for k, n in enumerate(names)},
        recall={n: _share(table[k, k], table[k].sum()) for k, n in enumerate(names)},
        balance=class_balance(labels, names),
    )


def _share(part: int | np.integer[Any], whole: int | np.integer[Any]) -> float | None:
    return int(part) / int(whole) if whole else None
