"""Latency and lead of a detector against a trial's true slip, without rewarding false alarms.

A detector that always reports slip would have the best latency and the longest lead. So each
detection is first judged: missed, false early, late, or counted; only the counted ones have times,
and the four numbers always add up to the trials. Incipient slip ends where gross slip begins, and
gross slip ends where the sensor and the plate stop moving on each other: a detection after that
has no use, however long the recording is, and without this bound a detector that reports
gross slip for as long as the plate lies still would miss nothing. Each evaluation, choice and
search judges by `is_false_early` and `is_late`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sliplab.analysis.metrics.intervals import interval
from sliplab.storage.schema.evaluation import (
    LatencyByOnset,
    LatencyFigures,
    LeadFigures,
    TrialLatency,
)
from sliplab.storage.schema.label import KINDS, Kind, TrialLabel

NEVER = int(np.iinfo(np.int64).max)
"""The time of an onset that was not detected, in arrays of times."""


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
class TrueSlip:
    """True onsets and end of a trial's slip, nanoseconds on the time line of its windows.

    Attributes:
        incipient_ns, gross_ns: the onsets.
        end_ns: where gross slip ended.

    Raises:
        ValueError: not in this order.
    """

    incipient_ns: int
    gross_ns: int
    end_ns: int

    def __post_init__(self) -> None:
        """Check the order of the three times."""
        if self.gross_ns < self.incipient_ns:
            raise ValueError(
                f"gross onset {self.gross_ns} ns is before incipient onset {self.incipient_ns} ns"
            )
        if self.end_ns < self.gross_ns:
            raise ValueError(f"end {self.end_ns} ns is before gross onset {self.gross_ns} ns")


def true_slip(label: TrialLabel) -> TrueSlip | None:
    """Return the slip of a labelled trial; None where the label lacks an onset.

    A reviewer may have set the gross onset after the end: the slip then ends as it begins.
    """
    return slip_of(label.incipient_ns, label.gross_ns, label.end_ns)


def slip_of(incipient_ns: int | None, gross_ns: int | None, end_ns: int) -> TrueSlip | None:
    """Return a slip that ends with its gross onset at the earliest; None where an onset lacks."""
    if incipient_ns is None or gross_ns is None:
        return None
    return TrueSlip(incipient_ns, gross_ns, max(end_ns, gross_ns))


def is_false_early(found_ns: Any, onset_ns: Any, tolerance_ns: Any) -> Any:
    """Check if a detection comes before the onset by MORE than the tolerance.

    Args:
        found_ns: an integer or an array of them, `NEVER` where nothing was detected; likewise:
        onset_ns: by the label.
        tolerance_ns: of a detection before it.
    """
    return found_ns < onset_ns - tolerance_ns


def is_late(found_ns: Any, end_ns: Any) -> Any:
    """Check if a detection comes at the end of its event or after it.

    Args:
        found_ns: an integer or an array of them, `NEVER` where nothing was detected (not late).
        end_ns: likewise: gross onset for incipient slip, the slip's end for gross slip.
    """
    return (found_ns >= end_ns) & (found_ns != NEVER)


def score_trial(detections: DetectedOnsets, slip: TrueSlip, false_early_ns: int) -> TrialLatency:
    """Judge one trial; see the module.

    Args:
        detections: the detector's onsets.
        slip: the true onsets, on the same time line.
        false_early_ns: a detection earlier than the label's onset by MORE than this is false.

    Raises:
        ValueError: a negative tolerance.
    """
    if false_early_ns < 0:
        raise ValueError(f"false_early_ns = {false_early_ns}: must not be negative")
    found, gross_found = detections.incipient_ns, detections.gross_ns
    early, late, counted = _judge(found, slip.incipient_ns, slip.gross_ns, false_early_ns)
    early_gross, late_gross, gross = _judge(gross_found, slip.gross_ns, slip.end_ns, false_early_ns)
    lead = None if counted is None or found is None else _ms(slip.gross_ns - found)
    return TrialLatency(
        latency_incipient_ms=counted,
        latency_gross_ms=gross,
        lead_ms=lead,
        late_incipient_ms=late,
        late_gross_ms=late_gross,
        missed_incipient=found is None,
        missed_gross=gross_found is None,
        false_early_incipient=early,
        false_early_gross=early_gross,
    )


def summarise_latency(trials: Sequence[TrialLatency]) -> LatencyByOnset:
    """Latency over trials, of either onset; a missed or late one is infinite in the median."""
    counts = {kind: _not_counted(trials, kind) for kind in KINDS}
    values = {
        "incipient": [t.latency_incipient_ms for t in trials],
        "gross": [t.latency_gross_ms for t in trials],
    }
    found = {
        kind: LatencyFigures(**_describe(values[kind], of["missed"] + of["late"], np.inf), **of)
        for kind, of in counts.items()
    }
    return LatencyByOnset(**found)


def summarise_lead(trials: Sequence[TrialLatency]) -> LeadFigures:
    """Lead over trials; missed, late and false early ones are those of the incipient detection.

    A missed or late one is no lead at all, below all others, in the median.
    """
    of = _not_counted(trials, "incipient")
    found = _describe([t.lead_ms for t in trials], of["missed"] + of["late"], -np.inf)
    return LeadFigures(**found, detected_first=found["n"], **of)


def _not_counted(trials: Sequence[TrialLatency], kind: Kind) -> dict[str, int]:
    return {
        "missed": sum(getattr(t, f"missed_{kind}") for t in trials),
        "late": sum(getattr(t, f"late_{kind}_ms") is not None for t in trials),
        "false_early": sum(getattr(t, f"false_early_{kind}") for t in trials),
    }


def _judge(
    found: int | None, onset: int, end: int, tolerance: int
) -> tuple[bool, float | None, float | None]:
    """Return false early, the delay if late, and the latency if it counts, in ms."""
    if found is None:
        return False, None, None
    if is_false_early(found, onset, tolerance):
        return True, None, None
    if is_late(found, end):
        return False, _ms(found - end), None
    return False, None, _ms(found - onset)


def _ms(difference_ns: int) -> float:
    return int(difference_ns) / 1e6


def median_with_lost(there: Sequence[float] | Any, lost: int, lost_ms: float) -> float | None:
    """Return the median of values and of `lost` infinite ones; None if it is infinite."""
    every = np.concatenate([np.asarray(there, np.float64), np.full(lost, lost_ms)])
    median = float(np.median(every)) if len(every) else np.inf
    return median if np.isfinite(median) else None


def median_span(
    there: Sequence[float], lost: int, lost_ms: float, least: float = -np.inf
) -> tuple[float | None, float | None] | None:
    """Return the interval of that median, an end None where it is infinite; None without one.

    Args:
        least: the smallest value that there can be.
    """
    span = interval([*there, *([lost_ms] * lost)], "median", least)
    if span is None or not np.isfinite(span).any():
        return None
    low, high = (float(end) if np.isfinite(end) else None for end in span)
    return low, high


def _describe(values: Sequence[float | None], lost: int, lost_ms: float) -> dict[str, Any]:
    """Statistics of the values that are there; None where one cannot be computed.

    ``std`` is the sample standard deviation (divisor n - 1), so it needs two values; percentiles
    interpolate linearly between order statistics.

    Args:
        lost: missed or late detections, which count in the median. lost_ms: as what, infinite.
    """
    there = np.array([v for v in values if v is not None], np.float64)
    n = len(there)
    if n == 0:
        return {**dict.fromkeys(("mean", "std", "median", "p95", "min", "max")), "n": 0}
    return {
        "mean": float(there.mean()),
        "std": float(there.std(ddof=1)) if n > 1 else None,
        "median": median_with_lost(there, lost, lost_ms),
        "p95": float(np.percentile(there, 95)),
        "min": float(there.min()),
        "max": float(there.max()),
        "n": n,
    }
