"""Sanity checks of the figures, each based on an invariant.

Permuted classes: which class is called 0 is a convention, so renaming classes in the network's
outputs and in the labels must change no figure (a silent network once looked 96 % right by its
class 0). Shuffled labels: a network that learned from labels dealt out at random must be at
chance, or something other than the training labels leaks the answer.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics.classification import CLASSES, Counts, IntArray, Labels
from sliplab.analysis.networks import training
from sliplab.analysis.networks.network import set_weights
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.networks.training import Fitted, restore
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.network_settings import NetworkSettings
from sliplab.protocols.training import Training
from sliplab.protocols.windows import Windows
from sliplab.storage.schema.evaluation import Classification


class CheckFailed(Exception):
    """A figure of the network cannot be trusted; the message says why."""


Predict = Callable[[tuple[int, ...]], Counts]
"""Spike counts (n, 3) of a network whose outputs of class k are the old ones of ``order[k]``."""


def permuted(fitted: Fitted, x: SparseWindows) -> Predict:
    """The trained network with its output neurons in another order."""

    def predict(order: tuple[int, ...]) -> Counts:
        net = restore(fitted)
        values = dict(fitted.state_dict)
        for name in ("fc2.weight", "fc2.bias"):
            old = values[name]
            # output j is of class j % classes
            grouped = old.reshape(-1, len(fitted.classes), *old.shape[1:])
            values[name] = grouped[:, list(order)].reshape(old.shape)
        set_weights(net, values)
        return SpikeEngine(net, fitted.windows.cells).counts(x)

    return predict


def check_permutations(
    predict: Predict, labels: Labels, score: Callable[[Counts, Labels], Classification]
) -> int:
    """Permute the classes in all six orders, in outputs and labels: nothing may change.

    Args:
        predict: gives the counts of a network with permuted outputs.
        score: how counts are scored; `metrics.classification.score` except in tests.

    Returns:
        how many orders were tried.

    Raises:
        CheckFailed: a figure changed.
    """
    labels = metrics.check_labels(labels)
    first = score(predict((0, 1, 2)), labels)
    orders = list(itertools.permutations(range(len(CLASSES))))
    for order in orders:
        place = np.argsort(order)  # old class -> new class
        found = score(predict(order), place[labels])
        table = np.asarray(first.confusion)[list(order)][:, [*order, len(CLASSES)]]
        if found.accuracy != first.accuracy:
            raise CheckFailed(
                f"classes in the order {order} give the accuracies {found.accuracy}, in their own "
                f"{first.accuracy}: something depends on which class comes first"
            )
        if not np.array_equal(found.confusion, table):
            raise CheckFailed(f"classes in the order {order} give another confusion matrix")
        for name in ("precision", "recall", "balance"):
            old, new = getattr(first, name), getattr(found, name)
            if any(new[CLASSES[k]] != old[CLASSES[order[k]]] for k in range(len(CLASSES))):
                raise CheckFailed(f"classes in the order {order} give another {name}: {new}")
    return len(orders)


@dataclass(frozen=True)
class Chance:
    """Result of training on shuffled labels.

    Attributes:
        shuffled: test accuracy (argmax, ties shared) after each training on shuffled labels.
        low, high: Student's interval of their mean.
        true: test accuracy after the same training on the true labels.
        level: of the interval.
    """

    shuffled: tuple[float, ...]
    low: float
    high: float
    true: float
    level: float


Part = tuple[SparseWindows, IntArray]
"""Windows and their classes."""


def balanced(part: Part, per_class: int, seed: int) -> Part:
    """Draw equally many windows of each class, at most `per_class`, in shuffled order.

    Raises:
        ValueError: a class has none.
    """
    windows, labels = part
    size = min(per_class, int(np.bincount(labels, minlength=len(CLASSES)).min()))
    if not size:
        raise ValueError("the check of shuffled labels needs windows of every class")
    rng = np.random.Generator(np.random.PCG64(seed))
    rows = [
        rng.choice(np.flatnonzero(labels == k), size, replace=False) for k in range(len(CLASSES))
    ]
    chosen = rng.permutation(np.concatenate(rows))
    return windows.take(chosen), labels[chosen]


def shuffle(labels: IntArray, seed: int) -> IntArray:
    """Return the labels, shuffled over the windows."""
    return np.random.Generator(np.random.PCG64(seed)).permutation(labels)


def shuffled_chance(
    train: Part,
    validation: Part,
    test: Part,
    network: NetworkSettings,
    windows: Windows,
    how: Training,
    runs: int = 8,
    per_class: int = 300,
    level: float = 0.999,
    deal: Callable[[IntArray, int], IntArray] = shuffle,
) -> Chance:
    """Train on shuffled labels, several times, and score on true test labels.

    Chance is exactly a third for any test windows: training labels are dealt out in
    equal numbers, so each class is as likely as another to be the one that a network calls some
    kind of window. One run may still be off by more than its windows' own scatter, because whole
    kinds of windows are called alike; so the interval is one of runs, not of windows.

    Args:
        how: `epochs` and the rest of the training.
        runs: shuffles, each with its own weights.
        per_class: windows of a class to learn from at most, and as many to choose an epoch by.
        deal: how labels are shuffled; `shuffle` but in tests.

    Raises:
        ValueError: a class has no windows.
    """
    learn, choose = balanced(train, per_class, 0), balanced(validation, per_class, 1)
    test_x, test_y = test

    def reached(seed: int, learn_y: IntArray, choose_y: IntArray) -> float:
        fitted = training.fit(learn[0], learn_y, choose[0], choose_y, network, windows, how, seed)
        found = metrics.accuracy(training.predict_counts(fitted, test_x), test_y).argmax
        if found is None:
            raise ValueError("the check of shuffled labels needs test windows")
        return found

    each = [reached(seed, deal(learn[1], seed), deal(choose[1], seed)) for seed in range(runs)]
    mean, spread = float(np.mean(each)), float(np.std(each, ddof=1))
    half = float(student.ppf(0.5 + level / 2, runs - 1)) * spread / runs**0.5
    return Chance(tuple(each), mean - half, mean + half, reached(0, learn[1], choose[1]), level)


def check_chance(found: Chance) -> None:
    """Shuffled labels must be at chance, and true ones above it.

    Raises:
        CheckFailed: they are not. The second makes the first mean something: a training too short
            to learn anything would always be at chance.
    """
    chance = 1 / len(CLASSES)
    if not found.low <= chance <= found.high:
        raise CheckFailed(
            f"a network that learned from shuffled labels is right in {found.shuffled} of the test "
            f"windows; their mean lies in {found.low:.3f}..{found.high:.3f}, chance is a third: "
            "something other than the training labels gives it the answer"
        )
    if not found.true > max(found.high, chance):
        raise CheckFailed(
            f"the same training on true labels reaches {found.true:.3f}, not more than shuffled "
            f"ones may ({found.high:.3f}): it learned nothing, so the check says nothing"
        )
