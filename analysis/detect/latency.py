"""How late a detector is, and how far ahead of gross slip, without rewarding false alarms.

A detector that cries slip at once would have the best latency and the longest lead. So each
detection is first judged: missed, false early, or counted; only the counted ones have times, and
the three numbers always add up to the trials.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from analysis.detect.detection import Found

Summary = dict[str, float | int | None]


@dataclass(frozen=True)
class TrialLatency:
    """One trial's detections against its true onsets.

    Attributes:
        latency_incipient_ms: detection minus true onset; negative down to the tolerance where it
            came early; None where missed or false early.
        latency_gross_ms: the same for gross slip.
        lead_ms: true gross onset minus incipient detection; negative where the detection came
            after gross slip began; None where the incipient detection is missed or false early.
        missed_incipient, missed_gross: there was no detection.
        false_early_incipient, false_early_gross: it came before the true onset by more than the
            tolerance.
        detected_first: the incipient detection counts and came before gross slip began.
    """

    latency_incipient_ms: float | None
    latency_gross_ms: float | None
    lead_ms: float | None
    missed_incipient: bool
    missed_gross: bool
    false_early_incipient: bool
    false_early_gross: bool
    detected_first: bool


def score_trial(
    detections: Found, incipient_ns: int, gross_ns: int, false_early_ns: int
) -> TrialLatency:
    """Judge one trial.

    Args:
        detections: what the detector said.
        incipient_ns, gross_ns: true onsets, on the same time line, nanoseconds.
        false_early_ns: a detection earlier than the true onset by MORE than this is false.

    Raises:
        ValueError: gross slip truly begins before incipient slip, or a negative tolerance.
    """
    if gross_ns < incipient_ns:
        raise ValueError(f"gross onset {gross_ns} ns is before incipient onset {incipient_ns} ns")
    if false_early_ns < 0:
        raise ValueError(f"false_early_ns = {false_early_ns}: must not be negative")
    incipient, early_incipient = _judge(detections.incipient_ns, incipient_ns, false_early_ns)
    gross, early_gross = _judge(detections.gross_ns, gross_ns, false_early_ns)
    lead = None
    if incipient is not None and detections.incipient_ns is not None:
        lead = _ms(gross_ns - detections.incipient_ns)
    return TrialLatency(
        latency_incipient_ms=incipient,
        latency_gross_ms=gross,
        lead_ms=lead,
        missed_incipient=detections.incipient_ns is None,
        missed_gross=detections.gross_ns is None,
        false_early_incipient=early_incipient,
        false_early_gross=early_gross,
        detected_first=lead is not None and lead > 0,
    )


def summarise_latency(trials: Sequence[TrialLatency]) -> dict[str, Summary]:
    """Latency over trials: ``{"incipient": {...}, "gross": {...}}``.

    Each holds mean, std, median, p95, min, max (milliseconds) over the n counted detections, and
    missed and false_early; ``n + missed + false_early`` is the number of trials.
    """
    return {
        "incipient": {
            **_describe([t.latency_incipient_ms for t in trials]),
            "missed": sum(t.missed_incipient for t in trials),
            "false_early": sum(t.false_early_incipient for t in trials),
        },
        "gross": {
            **_describe([t.latency_gross_ms for t in trials]),
            "missed": sum(t.missed_gross for t in trials),
            "false_early": sum(t.false_early_gross for t in trials),
        },
    }


def summarise_lead(trials: Sequence[TrialLatency]) -> Summary:
    """Lead over trials: min, mean, std, median, p95, max (milliseconds) over n counted leads.

    A late incipient detection stays in, as a negative lead; ``detected_first`` counts the
    positive ones. ``n + missed + false_early`` is the number of trials.
    """
    return {
        **_describe([t.lead_ms for t in trials]),
        "detected_first": sum(t.detected_first for t in trials),
        "missed": sum(t.missed_incipient for t in trials),
        "false_early": sum(t.false_early_incipient for t in trials),
    }


def _judge(found: int | None, true: int, tolerance: int) -> tuple[float | None, bool]:
    """(latency in ms or None, whether it was false early)."""
    if found is None:
        return None, False
    if found < true - tolerance:
        return None, True
    return _ms(found - true), False


def _ms(difference_ns: int) -> float:
    return int(difference_ns) / 1e6


def _describe(values: Sequence[float | None]) -> dict[str, Any]:
    """Statistics of the values that are there; None where one cannot be computed.

    ``std`` is the sample standard deviation (divisor n - 1), so it needs two values; percentiles
    interpolate linearly between order statistics.
    """
    there = np.array([v for v in values if v is not None], np.float64)
    n = len(there)
    if n == 0:
        names = ("mean", "std", "median", "p95", "min", "max")
        return {**dict.fromkeys(names), "n": 0}
    return {
        "mean": float(there.mean()),
        "std": float(there.std(ddof=1)) if n > 1 else None,
        "median": float(np.median(there)),
        "p95": float(np.percentile(there, 95)),
        "min": float(there.min()),
        "max": float(there.max()),
        "n": n,
    }
