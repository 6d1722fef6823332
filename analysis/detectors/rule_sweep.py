"""The paper's rule at every smoothing and margin of a grid: detections, scores and the choice.

A search needs dozens of pairs on every trial of every network, so `sweep` computes the leads once
for all margins, and arrays of times are compared.

The paper chose its window by the latency on test trials, and then reported that latency. Here the
choice is made on validation trials unless the paper's way is requested. A bound on the rate of
false early detections excludes settings that always report slip. It applies to both onsets, which
share one margin: without a bound on the second, the quickest first detection came with false gross
slip in nine trials of ten. The same bound limits missed and late detections: a margin that a
quarter of the trials never reach would satisfy every other bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.detector_comparison import allowed_early, merit
from sliplab.analysis.detectors.detectors import Levels, Predictions, Smoothing, decide
from sliplab.analysis.detectors.latency import (
    NEVER,
    DetectedOnsets,
    TrueSlip,
    is_false_early,
    is_late,
    score_trial,
    summarise_latency,
)
from sliplab.analysis.detectors.smoothing_rule import paper_level
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import RuleChoice

I64 = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Trials:
    """True slip of trials and what counts as too early, int64 (n,), ns."""

    incipient_ns: I64
    gross_ns: I64
    end_ns: I64
    tolerance_ns: I64

    def uncounted(self, found: I64) -> Uncounted:
        """Count the detections that do not count.

        Args:
            found: int64 (n, ..., 2), incipient and gross, `NEVER` where there is none.
        """
        onset, over = (
            np.stack(pair, axis=-1).reshape(len(found), *[1] * (found.ndim - 2), 2)
            for pair in ((self.incipient_ns, self.gross_ns), (self.gross_ns, self.end_ns))
        )
        tolerance = self.tolerance_ns.reshape(len(found), *[1] * (found.ndim - 1))
        return Uncounted(
            is_false_early(found, onset, tolerance), found == NEVER, is_late(found, over)
        )


@dataclass(frozen=True)
class Uncounted:
    """Masks over detections, (n, ..., 2) as these: at most one is true of each."""

    false_early: Mask
    missed: Mask
    late: Mask


def sweep(
    counts: npt.NDArray[np.integer],
    end_ns: I64,
    smoothings: Sequence[int],
    margins: Sequence[float],
) -> I64:
    """Detect both onsets of one trial by each pair.

    Args:
        counts: raw output spikes, integer (n, 3), windows in the order of time.
        end_ns: int64 (n,), end of each window.

    Returns:
        int64 (smoothings, margins, 2): incipient and gross detection, `NEVER` where there is none.
    """
    found = np.full((len(smoothings), len(margins), 2), NEVER, np.int64)
    windows = Predictions(counts.astype(np.int64), counts.sum(axis=1), end_ns)
    for s, smoothing in enumerate(smoothings):
        evidence = Smoothing(smoothing).evidence(windows)
        for m, margin in enumerate(margins):
            level = paper_level(margin)
            onsets = decide(evidence, Levels(level, level))
            for k, onset in enumerate((onsets.incipient_ns, onsets.gross_ns)):
                if onset is not None:
                    found[s, m, k] = onset
    return found


def choose_pair(
    found: I64, trials: Trials, smoothings: Sequence[int], margins: Sequence[float], rate: float
) -> tuple[int, int]:
    """Places of the pair that `choose_smoothing` chooses; see there.

    Args:
        found: int64 (n, smoothings, margins, 2), n at least 1.
        rate: share of the trials that may be false early, and missed or late, for either onset.
    """
    out = trials.uncounted(found)
    early, lost = out.false_early, out.missed | out.late
    incipient = found[..., 0]
    latency = (incipient - trials.incipient_ns[:, None, None]) / 1e6
    late = np.where(lost[..., 0], np.inf, latency)
    allowed = allowed_early(rate, len(found))

    def rank(s: int, m: int) -> tuple[float, ...]:
        amiss = [*early[:, s, m].sum(axis=0).tolist(), *lost[:, s, m].sum(axis=0).tolist()]
        values = np.sort(late[:, s, m][~early[:, s, m, 0]])
        median = float(np.median(values)) if values.size else np.inf
        high = np.inf
        if values.size:
            high = float(np.percentile(values, 95, method="inverted_cdf"))
        excess = sum(max(n - allowed, 0) for n in amiss)
        return excess, median, high, sum(amiss[:2]), smoothings[s], -margins[m]

    pairs = [(s, m) for s in range(len(smoothings)) for m in range(len(margins))]
    return min(pairs, key=lambda pair: rank(*pair))


@dataclass(frozen=True)
class SpikeCounts:
    """Spike counts int64 (n, 3) and window ends int64 ns (n,) of a trial, and its true slip."""

    counts: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]
    slip: TrueSlip


def choose_smoothing(trials: Sequence[SpikeCounts], settings: Detection, split: str) -> RuleChoice:
    """The pair of the grid with the lowest median incipient latency within the bound.

    Among equals the lower 95th percentile, then fewer false early, then the shorter window, then
    the wider margin. If no pair keeps the bounds for both onsets, the one that exceeds them least
    is taken: the result says the numbers.

    Args:
        settings: grid, bound and tolerance; its own smoothing and margin are ignored.
        split: where the trials are from.

    Raises:
        ValueError: no trials.
    """
    if not trials:
        raise ValueError(f"no {split} trials with both onsets to choose by")
    tolerance = round(settings.false_early_ms * 1e6)
    grid = settings.smoothing_grid, settings.margin_grid
    found = np.stack([sweep(t.counts, t.end_ns, *grid) for t in trials])
    columns = zip(*((*vars(t.slip).values(), tolerance) for t in trials), strict=True)
    known = Trials(*(np.array(times, np.int64) for times in columns))
    s, m = choose_pair(found, known, *grid, settings.false_early_rate)
    scored = []
    for onsets, trial in zip(found[:, s, m].tolist(), trials, strict=True):
        detected = DetectedOnsets(*(None if ns == NEVER else ns for ns in onsets))
        scored.append(score_trial(detected, trial.slip, tolerance))
    median, _ = merit(scored)
    latency = summarise_latency(scored)
    counts = {
        f"{name}{suffix}": getattr(figures, name)
        for figures, suffix in ((latency.incipient, ""), (latency.gross, "_gross"))
        for name in ("false_early", "missed", "late")
    }
    return RuleChoice(
        smoothing=settings.smoothing_grid[s],
        margin=settings.margin_grid[m],
        split=split,
        trials=len(trials),
        allowed=allowed_early(settings.false_early_rate, len(trials)),
        median_ms=median if np.isfinite(median) else None,
        **counts,
    )


def settled(settings: Detection, choice: RuleChoice | None) -> Detection:
    """The settings with the chosen smoothing and margin; as they are without a choice."""
    if choice is None:
        return settings
    return settings.model_copy(update={"smoothing": choice.smoothing, "margin": choice.margin})
