"""Accuracy of groups of windows, with intervals clustered by trial.

Fifty windows of a trial see the same papillae slip: they are right together and wrong together. An
interval that counts them as fifty independent ones is several times too narrow. So intervals are
over trials (`analysis.metrics.intervals`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import (
    CLASSES,
    Counts,
    IntArray,
    Labels,
    check,
    winners,
)
from sliplab.analysis.metrics.intervals import mean_interval, share_interval
from sliplab.storage.schema.evaluation import Share, Tenth, TrialWindows

FloatArray = npt.NDArray[np.float64]

TrialName = tuple[str, str, dict[str, str]]
"""Campaign, trial id, and levels by factor as text."""
TENTHS = 10
"""Parts of a phase."""


def strict_hits(counts: Counts, labels: Labels) -> FloatArray:
    """1 where the unique winner is right, else 0; (n,)."""
    counts, labels = check(counts, labels)
    return (winners(counts) == labels).astype(np.float64)


def share(values: FloatArray, trial: IntArray) -> Share:
    """Share of `values`, its interval over trials, and the numbers of windows and trials.

    Args:
        values: (n,), what a window counts, 0..1.
        trial: integer (n,), the trial of each window.
    """
    return _summary(values, trial, share_interval)


def mean(values: FloatArray, trial: IntArray) -> Share:
    """The same of values of any sign, such as differences, with Student's interval."""
    return _summary(values, trial, mean_interval)


def _summary(
    values: FloatArray,
    trial: IntArray,
    measure: Callable[[FloatArray, FloatArray], tuple[float, float] | None],
) -> Share:
    which, place = np.unique(trial, return_inverse=True)
    sums, sizes = (
        np.bincount(place, weights, minlength=len(which)).astype(np.float64)
        for weights in (values, None)
    )
    span = measure(sums, sizes)
    return Share(
        share=float(values.mean()) if len(values) else None,
        low=None if span is None else span[0],
        high=None if span is None else span[1],
        n=len(values),
        trials=len(which),
    )


def by_factor(
    hits: FloatArray, trial: IntArray, levels: Mapping[int, Mapping[str, str]]
) -> dict[str, dict[str, Share]]:
    """Share of hits by each factor's levels.

    Args:
        hits: (n,), 0..1.
        trial: integer (n,).
        levels: of each trial, its level of each factor as text; levels come out in the order in
            which they are first seen here.
    """
    found: dict[str, dict[str, Share]] = {}
    for factor in dict.fromkeys(name for of in levels.values() for name in of):
        found[factor] = {}
        for text in dict.fromkeys(of[factor] for of in levels.values() if factor in of):
            ours = [number for number, of in levels.items() if of.get(factor) == text]
            there = np.isin(trial, ours)
            if there.any():
                found[factor][text] = share(hits[there], trial[there])
    return found


def by_tenth(
    hits: FloatArray,
    labels: Labels,
    trial: IntArray,
    fraction: FloatArray,
    names: Sequence[str] = CLASSES,
) -> dict[str, tuple[Tenth, ...]]:
    """Recall of each class by tenths of its phase, ten rows a class.

    Args:
        hits: (n,), 1 where a window was classified correctly.
        fraction: (n,), where in its class's phase the middle of the window lies, 0..1; windows
            outside, or NaN, are left out.
        names: of the classes.
    """
    result = {}
    inside = (fraction >= 0) & (fraction <= 1)
    tenth = np.zeros(len(labels), np.int64)
    tenth[inside] = np.minimum((fraction[inside] * TENTHS).astype(np.int64), TENTHS - 1)
    for k, name in enumerate(names):
        rows = []
        for part in range(TENTHS):
            there = inside & (labels == k) & (tenth == part)
            rows.append(Tenth(tenth=part + 1, **dict(share(hits[there], trial[there]))))
        result[name] = tuple(rows)
    return result


def by_trial(
    counts: Counts,
    labels: Labels,
    trial: IntArray,
    named: Callable[[int], TrialName],
    names: Sequence[str] = CLASSES,
) -> list[TrialWindows]:
    """Return one row a trial, the worst first: windows, errors, and confusions.

    Args:
        named: gives campaign, id and condition of a trial.
        names: of the classes.
    """
    counts, labels = check(counts, labels)
    stated = winners(counts)
    rows = []
    for number in np.unique(trial).tolist():
        there = trial == number
        true, called = labels[there], stated[there]
        wrong = called != true
        taken = {
            f"{names[k]} as {'undecided' if j < 0 else names[j]}": int(
                ((true == k) & (called == j)).sum()
            )
            for k in range(len(names))
            for j in (*range(len(names)), -1)
            if j != k and ((true == k) & (called == j)).any()
        }
        campaign, name, condition = named(number)
        rows.append(
            TrialWindows(
                campaign=campaign,
                trial=name,
                condition=condition,
                n=int(there.sum()),
                errors=int(wrong.sum()),
                strict=float(1 - wrong.mean()),
                taken=taken,
            )
        )
    return sorted(rows, key=lambda row: row.strict)
