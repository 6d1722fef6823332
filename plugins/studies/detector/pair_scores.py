"""Scores of a pair of smoothing and margin, by arrays of times.

Tests hold each figure to `analysis.detectors.latency`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.rule_sweep import Trials

I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Figures:
    """Scores of a pair over trials.

    Attributes:
        mean_ms, p95_ms: incipient latency of counted detections; None without one.
        gross_mean_ms: the same of gross slip.
        lead_min_ms: shortest lead of gross slip's labelled onset over a counted detection.
        missed, missed_gross: shares of trials without a detection.
        late, late_gross: shares of trials whose detection came after the event.
        false_early, false_early_gross: shares of trials whose detection came too early.
        false_early_either: of trials where either did.
        missed_either: of trials where either is missing.
        late_either: of trials where either came late.
        lost, lost_gross, lost_either: of trials missed or late.
        trials: how many.
    """

    mean_ms: float | None
    p95_ms: float | None
    gross_mean_ms: float | None
    lead_min_ms: float | None
    missed: float
    missed_gross: float
    missed_either: float
    late: float
    late_gross: float
    late_either: float
    lost: float
    lost_gross: float
    lost_either: float
    false_early: float
    false_early_gross: float
    false_early_either: float
    trials: int


def score(found: I64, trials: Trials) -> Figures:
    """One pair's detections int64 (n, 2) against the labels of n trials, n at least 1."""
    out = trials.uncounted(found)
    counted = ~(out.false_early | out.missed | out.late)
    incipient, gross = (found[:, k][counted[:, k]] for k in (0, 1))
    late = (incipient - trials.incipient_ns[counted[:, 0]]) / 1e6
    late_gross = (gross - trials.gross_ns[counted[:, 1]]) / 1e6
    lead = (trials.gross_ns[counted[:, 0]] - incipient) / 1e6

    def share(which: Mask) -> float:
        return np.count_nonzero(which) / len(found)

    shares = {}
    for name, mask in {**vars(out), "lost": out.missed | out.late}.items():
        first, second = mask.T
        shares[name], shares[f"{name}_gross"] = share(first), share(second)
        shares[f"{name}_either"] = share(first | second)
    return Figures(
        mean_ms=float(late.mean()) if late.size else None,
        p95_ms=float(np.percentile(late, 95)) if late.size else None,
        gross_mean_ms=float(late_gross.mean()) if late_gross.size else None,
        lead_min_ms=float(lead.min()) if lead.size else None,
        trials=len(found),
        **shares,
    )
