"""Estimate two onsets from spike counts of consecutive windows.

A single window is unreliable. The paper averages counts over a sliding window and accepts a class
only when it leads by a margin. This module implements that rule and defines its edge cases: the
start of the average, ties, and the time of a detection.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.metrics.classification import CLASSES, GROSS, INCIPIENT, winners
from sliplab.protocols.detection import Detection


@dataclass(frozen=True)
class DetectedOnsets:
    """The onsets that a detector found in one trial.

    Attributes:
        incipient_ns: estimated incipient onset, nanoseconds on the time line of the windows, or
            None if it was never detected.
        gross_ns: estimated gross onset, the first valid one after the incipient detection; None
            if there was none, or no incipient detection before it.
    """

    incipient_ns: int | None
    gross_ns: int | None


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
    Comparisons are made on whole sums of counts, so no rounding decides a margin.

    Args:
        counts: raw output spikes, integer (n, 3), windows in the order of time.
        end_ns: end of each window, integer nanoseconds (n,), strictly increasing.
        settings: sliding window and margin.

    Raises:
        ValueError: shapes or types that do not fit, times that do not increase.
    """
    counts, end_ns = np.asarray(counts), np.asarray(end_ns)
    if counts.ndim != 2 or counts.shape[1] != len(CLASSES):
        raise ValueError(f"counts have the shape {counts.shape}; expected (n, {len(CLASSES)})")
    if end_ns.shape != counts.shape[:1]:
        raise ValueError(f"{end_ns.shape} window ends for {counts.shape[0]} windows")
    if not (np.issubdtype(counts.dtype, np.integer) and np.issubdtype(end_ns.dtype, np.integer)):
        raise ValueError(f"counts are {counts.dtype} and ends {end_ns.dtype}; expected integers")
    if (end_ns[1:] <= end_ns[:-1]).any():
        raise ValueError("window ends do not increase")

    width = settings.smoothing
    trailing, held = _trailing(counts, width)
    valid = winners(trailing, settings.margin * width)
    valid[: width - 1] = -1

    incipient = _first(valid == INCIPIENT, 0)
    gross = None if incipient is None else _first(valid == GROSS, incipient + 1)
    return Detections(
        incipient_ns=None if incipient is None else int(end_ns[incipient]),
        gross_ns=None if gross is None else int(end_ns[gross]),
        smoothed=trailing / held[:, None],
        valid_class=valid,
    )


def lead_of(
    counts: npt.NDArray[np.integer], smoothing: int, target: int
) -> npt.NDArray[np.float64]:
    """Lead of a class's mean count over every other, float64 (n,); negative where it trails.

    -inf where the sliding window is not full. `detect` finds a class where this is above 0 and at
    least the margin.

    Args:
        counts: raw output spikes, integer (n, 3), windows in the order of time.
        smoothing: windows over which counts are averaged.
        target: the class.
    """
    trailing, _ = _trailing(counts, smoothing)
    rivals = np.delete(trailing, target, axis=1).max(axis=1, initial=0)
    lead: npt.NDArray[np.float64] = (trailing[:, target] - rivals) / smoothing
    lead[: smoothing - 1] = -np.inf
    return lead


def _trailing(
    counts: npt.NDArray[np.integer], width: int
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Sums over the last `width` windows (n, 3), and over how many windows there were (n,)."""
    n = len(counts)
    sums = np.zeros((n + 1, len(CLASSES)), np.int64)
    sums[1:] = counts.astype(np.int64).cumsum(axis=0)
    start = np.maximum(np.arange(1, n + 1) - width, 0)
    return sums[1:] - sums[start], np.arange(1, n + 1) - start


def _first(mask: npt.NDArray[np.bool_], start: int) -> int | None:
    found = np.flatnonzero(mask[start:])
    return start + int(found[0]) if len(found) else None
