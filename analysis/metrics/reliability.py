"""Calibration of the spike lead: the share right at each lead, and a probability from it.

A detection trusts a class that leads by eight spikes. How often is that right, and by how many
spikes does the network have to lead to be right in 99 of 100 windows? Spike counts are no
probabilities. One number, the temperature (Guo et al., 2017), makes them some; it is fitted on
validation windows only, and its scores are those of test windows.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.special import log_softmax

from sliplab.analysis.metrics.classification import Counts, IntArray, Labels, check
from sliplab.analysis.metrics.window_groups import share
from sliplab.storage.schema.evaluation import CalibrationScores, LeadShare, ProbabilityCalibration

FloatArray = npt.NDArray[np.float64]

BINS = 15
"""Bins of equal width for the expected calibration error (Guo et al.)."""

EDGES = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Leads of a row, from each of these to the next: half octaves, so that rows have windows enough,
and the usual margins (2 with one output neuron a class, 8 with four) begin one."""

_TEMPERATURES = (1e-2, 1e3)


def lead(counts: Counts) -> npt.NDArray[Any]:
    """Spikes by which the winner leads the next class, (n,); 0 for a tie."""
    ordered = np.sort(counts, axis=1)
    return np.asarray(ordered[:, -1] - ordered[:, -2])


def by_lead(counts: Counts, labels: Labels, trial: IntArray) -> list[LeadShare]:
    """Share right by lead in whole spikes, from 0 (a tie, no winner, never right) up.

    Args:
        trial: integer (n,), the trial of each window.

    Returns:
        a row for each of `EDGES` with windows.
    """
    counts, labels = check(counts, labels)
    by = lead(counts)
    place = np.searchsorted(EDGES, by, side="right") - 1
    right = (by > 0) & (counts.argmax(axis=1) == labels)
    rows = []
    for group in np.unique(place).tolist():
        there = place == group
        found = share(right[there].astype(np.float64), trial[there])
        rows.append(
            LeadShare(
                lead=EDGES[group],
                to=EDGES[group + 1] - 1 if group + 1 < len(EDGES) else None,
                right=int(right[there].sum()),
                **dict(found),
            )
        )
    return rows


def fit_temperature(counts: Counts, labels: Labels) -> float | None:
    """The temperature T for which softmax(counts / T) has the least cross-entropy.

    The mean cross-entropy is convex in 1 / T, so there is one minimum; it is looked for between
    0.01 and 1000 spikes. None without windows.
    """
    counts, labels = check(counts, labels)
    if not len(labels):
        return None
    low, high = np.log(_TEMPERATURES)
    found = minimize_scalar(
        lambda log_t: cross_entropy(counts, labels, float(np.exp(log_t))),
        bounds=(low, high),
        method="bounded",
        options={"xatol": 1e-6},
    )
    return float(np.exp(found.x))


def cross_entropy(counts: Counts, labels: Labels, temperature: float) -> float:
    """Mean of -log of the probability of the true class, in nats."""
    log_p = log_softmax(np.asarray(counts, np.float64) / temperature, axis=1)
    return -float(log_p[np.arange(len(labels)), labels].mean())


def expected_calibration_error(
    probabilities: FloatArray, labels: Labels, bins: int = BINS
) -> float:
    """Expected calibration error, 0..1: mean distance of confidence from accuracy over windows.

    Windows are put by their highest probability into bins of equal width. Where classes tie, each
    has its share of being right, so that the order of classes does not matter.
    """
    stated = probabilities.max(axis=1)
    top = probabilities == stated[:, None]
    right = top[np.arange(len(labels)), labels] / top.sum(axis=1)
    place = np.minimum((stated * bins).astype(np.int64), bins - 1)
    gap = np.bincount(place, right - stated, minlength=bins)
    return float(np.abs(gap).sum() / len(labels))


def calibration(
    counts: Counts, labels: Labels, held_counts: Counts, held_labels: Labels
) -> ProbabilityCalibration:
    """The temperature that validation windows give, and its scores on test windows.

    Args:
        counts, labels: of test windows.
        held_counts, held_labels: of validation windows; nothing else is fitted.
    """
    counts, labels = check(counts, labels)
    temperature = fit_temperature(held_counts, held_labels)
    if temperature is None or not len(labels):
        return ProbabilityCalibration(
            temperature=temperature, ece=None, cross_entropy=None, uncalibrated=None
        )

    def scores(t: float) -> CalibrationScores:
        p = np.exp(log_softmax(counts / t, axis=1))
        return CalibrationScores(
            ece=expected_calibration_error(p, labels),
            cross_entropy=cross_entropy(counts, labels, t),
        )

    return ProbabilityCalibration(
        temperature=temperature, **dict(scores(temperature)), uncalibrated=scores(1.0)
    )
