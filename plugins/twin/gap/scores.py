"""Deficit of a network against another on the same test trials."""

from __future__ import annotations

import numpy as np

from sliplab.analysis.evaluation.trials import EvaluatedTrials
from sliplab.analysis.metrics.intervals import share_difference
from sliplab.plugins.twin.document import Behind
from sliplab.storage.schema.evaluation import Classification


def macro_f1(found: Classification) -> float | None:
    """Return the mean over classes of the harmonic mean of precision and recall.

    A class that is never found counts 0. None where a class has no windows.
    """
    scores = []
    for name, recall in found.recall.items():
        if recall is None:
            return None
        precision = found.precision[name] or 0.0
        scores.append(2.0 * precision * recall / (precision + recall) if recall else 0.0)
    return float(np.mean(scores))


def behind(first: EvaluatedTrials, other: EvaluatedTrials) -> Behind:
    """Return the strict accuracy of the first network less that of the other.

    Both were judged on the same trials, of which the interval takes the differences.

    Raises:
        ValueError: they were not.
    """
    hits = [judged.hits_by_trial(with_campaign=True) for judged in (first, other)]
    if hits[0].keys() != hits[1].keys():
        raise ValueError("the networks were judged on other trials")
    pairs = [np.array(list(found.values()), np.float64).reshape(-1, 2).T for found in hits]
    (a, of_a), (b, of_b) = ((right.sum(), count.sum()) for right, count in pairs)
    span = share_difference((pairs[0][0], pairs[0][1]), (pairs[1][0], pairs[1][1]))
    return Behind(
        share=float(a / of_a - b / of_b) if of_a and of_b else None,
        low=None if span is None else span[0],
        high=None if span is None else span[1],
    )
