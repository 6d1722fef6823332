"""Estimate two onsets from spike counts of consecutive windows.

A single window is unreliable. The paper averages counts over a sliding window and accepts a class
only when it leads by a margin. This module implements that rule and defines its edge cases: the
start of the average, ties, and the time of a detection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detectors import (
    RULE,
    Levels,
    Predictions,
    Smoothing,
    Tuned,
    WindowEvidence,
    decide,
)
from sliplab.analysis.detectors.latency import DetectedOnsets
from sliplab.protocols.detection import Detection


def paper_level(margin: float) -> float:
    """Return the level that a lead of at least `margin` exceeds; without a margin any lead."""
    return max(0.0, float(np.nextafter(margin, -np.inf)))


class PaperRule(Tuned):
    """The paper's rule: the class of a window is the one that leads by the margin."""

    def classes(self, evidence: WindowEvidence, gross_found: bool = False) -> npt.NDArray[np.int8]:
        """See `Tuned`; only one class can lead."""
        leads = np.stack([evidence.no_slip, evidence.incipient, evidence.gross_after(-1)], axis=1)
        valid = leads > self.levels.incipient
        return np.where(valid.any(axis=1), valid.argmax(axis=1), -1).astype(np.int8)


def paper_rule(settings: Detection) -> PaperRule:
    """Return the paper's rule by its settings: its margin is the level of both onsets."""
    level = paper_level(settings.margin)
    name = f"{RULE}{settings.smoothing} windows"
    return PaperRule(name, Smoothing(settings.smoothing), Levels(level, level))


@dataclass(frozen=True)
class Detections(DetectedOnsets):
    """Result of the paper's rule on one trial, and its inputs.

    Attributes:
        smoothed: float64 (n, 3), trailing mean counts. The first ``smoothing - 1`` rows are means
            over the windows there are, for plots; they are never valid.
        valid_class: int8 (n,), the detected class of each window; -1 where none is valid.
    """

    smoothed: npt.NDArray[np.float64]
    valid_class: npt.NDArray[np.int8]


def detect(
    counts: npt.NDArray[np.integer], end_ns: npt.NDArray[np.int64], settings: Detection
) -> Detections:
    """Detect both onsets in the windows of one trial.

    Windows may overlap: `smoothing` of them, `stride` apart, then span
    ``length + (smoothing - 1) * stride``.

    A detection needs a full sliding window, so none comes before window ``smoothing - 1``. It is
    dated by the END of its newest window: before that moment the evidence was not all there.

    Args:
        counts: raw output spikes, integer (n, 3), windows in the order of time.
        end_ns: end of each window, integer nanoseconds (n,), strictly increasing.
        settings: sliding window and margin.

    Raises:
        ValueError: shapes or types that do not fit, times that do not increase.
    """
    counts, end_ns = np.asarray(counts), np.asarray(end_ns)
    if not (np.issubdtype(counts.dtype, np.integer) and np.issubdtype(end_ns.dtype, np.integer)):
        raise ValueError(f"counts are {counts.dtype} and ends {end_ns.dtype}; expected integers")
    rule = paper_rule(settings)
    windows = Predictions(counts.astype(np.int64), counts.sum(axis=1), end_ns)
    evidence = rule.detector.evidence(windows)
    found = decide(evidence, rule.levels)
    smoothed = evidence.smoothed.astype(np.float64)
    return Detections(found.incipient_ns, found.gross_ns, smoothed, rule.classes(evidence))
