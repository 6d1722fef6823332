"""Thresholds at a stated rate of false alarms, and what they are worth on other trials.

Every detector is set to the same number of false early detections on validation trials and judged
on test trials. The numbers are small, a percent of 130 trials is one of them, so each rate stands
with its exact interval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.analysis.detect.detectors import (
    Detector,
    Evidence,
    Labelled,
    Levels,
    decide,
    first_above,
)
from sliplab.analysis.detect.latency import TrialLatency, score_trial
from sliplab.analysis.detect.true_slip import TrueSlip


@dataclass(frozen=True)
class Judged:
    """A trial's evidence with its true onsets."""

    evidence: Evidence
    slip: TrueSlip


def judge(detector: Detector, trials: Sequence[Labelled]) -> list[Judged]:
    """What a detector makes of trials."""
    return [Judged(detector.evidence(t.predictions), t.slip) for t in trials]


def allowed_early(rate: float, trials: int) -> int:
    """How many of so many trials may be false early: the whole number not above their share."""
    return int(np.floor(rate * trials + 1e-9))


def set_levels(trials: Sequence[Judged], allowed: int, false_early_ns: int) -> Levels:
    """The lowest levels at which at most `allowed` trials are false early, for either onset.

    A level is the evidence that the trial after the allowed ones had before its onset; so it is
    found exactly, and a lower one would let that trial through. The gross level is found with the
    incipient one in force.

    Raises:
        ValueError: not more trials than are allowed to be false: nothing would bound a level.
    """
    if not 0 <= allowed < len(trials):
        raise ValueError(f"{allowed} of {len(trials)} trials may be false early: no bound")

    def level(highest: list[float]) -> float:
        return sorted(highest, reverse=True)[allowed]

    incipient = level(
        [
            _highest(t.evidence.incipient, t.evidence, 0, t.slip.incipient_ns - false_early_ns)
            for t in trials
        ]
    )
    highest = []
    for t in trials:
        first = first_above(t.evidence.incipient, incipient)
        if first is None:
            highest.append(-np.inf)
            continue
        gross = t.evidence.gross_after(first)
        highest.append(_highest(gross, t.evidence, first + 1, t.slip.gross_ns - false_early_ns))
    return Levels(incipient, level(highest))


def _highest(values: Any, evidence: Evidence, start: int, before_ns: int) -> float:
    """The highest value of windows from `start` on that end before a moment; -inf without any."""
    stop = int(np.searchsorted(evidence.end_ns, before_ns, side="left"))
    return float(values[start:stop].max(initial=-np.inf))


def outcomes(trials: Sequence[Judged], levels: Levels, false_early_ns: int) -> list[TrialLatency]:
    """Each trial's detections against its true onsets."""
    return [score_trial(decide(t.evidence, levels), t.slip, false_early_ns) for t in trials]


def merit(scored: Sequence[TrialLatency]) -> tuple[float, float]:
    """Median and 95th percentile incipient latency, ms; a missed or late one counts as infinite.

    So a detector cannot better its median by missing what is hard. False early trials are left
    out: they are bounded apart.
    """
    late = [
        np.inf if t.latency_incipient_ms is None else t.latency_incipient_ms
        for t in scored
        if not t.false_early_incipient
    ]
    if not late:
        return np.inf, np.inf
    ordered = np.sort(np.asarray(late, np.float64))
    # between two values a percentile of infinite ones would be no number
    return float(np.median(ordered)), float(np.percentile(ordered, 95, method="inverted_cdf"))
