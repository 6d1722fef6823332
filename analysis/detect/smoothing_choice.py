"""Smoothing window and margin of the paper's rule, from a stated grid, by stated trials.

The paper chose its window by the latency on test trials, and then reported that latency. Here the
choice is made on validation trials unless somebody asks for the paper's way, and a bound on false
early detections keeps the quickest setting from being the one that always cries slip. It holds for
either onset: one margin serves both, and without a bound on the second the quickest first
detection was bought with gross slip cried in nine trials of ten. As many may be missed and no more:
a margin that one trial in four never reaches keeps any other bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.detect.detection import detect
from analysis.detect.detector_choice import allowed_early, merit
from analysis.detect.latency import score_trial
from protocols.settings import Detection


@dataclass(frozen=True)
class Counted:
    """Spike counts int64 (n, 3) and window ends int64 ns (n,) of a trial, and its true onsets."""

    counts: npt.NDArray[np.int64]
    end_ns: npt.NDArray[np.int64]
    incipient_ns: int
    gross_ns: int


@dataclass(frozen=True)
class Choice:
    """What a grid gave.

    Attributes:
        smoothing, margin: the chosen ones.
        split: the trials that chose, ``validation`` or ``test``.
        trials: how many there were.
        allowed: trials that may be false early, for either onset.
        false_early, false_early_gross: trials that were.
        missed, missed_gross: trials without a detection; as many are allowed.
        median_ms: their median incipient latency, a missed one infinitely late; None if so.
    """

    smoothing: int
    margin: float
    split: str
    trials: int
    allowed: int
    false_early: int
    false_early_gross: int
    missed: int
    missed_gross: int
    median_ms: float | None


def choose_smoothing(trials: Sequence[Counted], settings: Detection, split: str) -> Choice:
    """The pair of the grid with the lowest median incipient latency within the bound.

    Among equals the lower 95th percentile, then fewer false early, then the shorter window, then
    the wider margin. If no pair keeps the bounds for both onsets, the one that exceeds them least
    is taken: the result says the numbers.

    Args:
        settings: grid, bound and tolerance; its own smoothing and margin are not looked at.
        split: where the trials are from.

    Raises:
        ValueError: no trials.
    """
    if not trials:
        raise ValueError(f"no {split} trials with both onsets to choose by")
    allowed = allowed_early(settings.false_early_rate, len(trials))
    tolerance = round(settings.false_early_ms * 1e6)
    found = []
    for smoothing in settings.smoothing_grid:
        for margin in settings.margin_grid:
            tried = settings.model_copy(update={"smoothing": smoothing, "margin": margin})
            scored = [
                score_trial(
                    detect(t.counts, t.end_ns, tried), t.incipient_ns, t.gross_ns, tolerance
                )
                for t in trials
            ]
            early = sum(s.false_early_incipient for s in scored)
            gross = sum(s.false_early_gross for s in scored)
            median, high = merit(scored)
            missed = sum(s.missed_incipient for s in scored)
            missed_gross = sum(s.missed_gross for s in scored)
            excess = sum(max(n - allowed, 0) for n in (early, gross, missed, missed_gross))
            rank = (excess, median, high, early + gross, smoothing, -margin)
            found.append((rank, (early, gross, missed, missed_gross), median))
    (*_, smoothing, negative), (early, gross, missed, missed_gross), median = min(found)
    return Choice(
        smoothing=int(smoothing),
        margin=-negative,
        split=split,
        trials=len(trials),
        allowed=allowed,
        false_early=early,
        false_early_gross=gross,
        missed=missed,
        missed_gross=missed_gross,
        median_ms=median if np.isfinite(median) else None,
    )


def settled(settings: Detection, choice: Choice | None) -> Detection:
    """The settings with the chosen smoothing and margin; as they are without a choice."""
    if choice is None:
        return settings
    return settings.model_copy(update={"smoothing": choice.smoothing, "margin": choice.margin})
