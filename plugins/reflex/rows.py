"""Results of a study of reflexes: drops prevented, distance fallen, force, reaction.

A drop is prevented where the plate falls without a reflex, and is held by one that was triggered
after the first tip had slipped: a detector that always triggers prevents nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.plugins.reflex.document import ReactionParts, ReflexRow, ReflexTrial

PARTS = ("window", "sensor", "network", "command", "actuator")
SLIDING_MM_S = 0.1
"""Speed above which a plate that has not stopped still slides."""
STOP_MM = 0.1
"""Distance from its stop at which a plate counts as dropped."""
_LAST_S = 0.05


def dropped(t_ms: Sequence[float], height_mm: Sequence[float], stroke_mm: float) -> bool:
    """Return whether a plate has dropped, by its heights until the sensor left.

    Args:
        t_ms: times of the heights, rising; 50 ms or more.
    """
    if -height_mm[-1] > stroke_mm - STOP_MM:
        return True
    before = float(np.interp(t_ms[-1] - 1e3 * _LAST_S, t_ms, height_mm))
    return (before - height_mm[-1]) / _LAST_S > SLIDING_MM_S


def extra_force_n(t_ms: Sequence[float], normal_n: Sequence[float], trigger_ms: float) -> float:
    """Return by how much the normal force came above that at a reflex's trigger, N."""
    at_trigger = float(np.interp(trigger_ms, t_ms, normal_n))
    later = [n for t, n in zip(t_ms, normal_n, strict=True) if t >= trigger_ms]
    return max(0.0, max(later, default=at_trigger) - at_trigger)


def reflex_rows(trials: Iterable[ReflexTrial]) -> tuple[ReflexRow, ...]:
    """Return one row for each detector and reflex, in the order of their first trials."""
    groups: dict[tuple[str | None, str | None], list[ReflexTrial]] = {}
    for trial in trials:
        groups.setdefault((trial.detector, trial.reflex), []).append(trial)
    without = {it.trial for it in groups.get((None, None), []) if it.dropped}
    return tuple(_row(*key, group, without) for key, group in groups.items())


def _row(
    detector: str | None, reflex: str | None, group: list[ReflexTrial], without: set[str]
) -> ReflexRow:
    done = [it for it in group if it.parts is not None]
    timely = [it for it in done if not it.early]
    would = [it for it in group if it.trial in without]
    held = sum(not it.dropped and it in timely for it in would)
    low, high = exact_interval(held, len(would)) if would else (None, None)
    extra = [it.extra_n for it in done if it.extra_n is not None]
    parts = [it.parts for it in timely if it.parts is not None]
    return ReflexRow(
        detector=detector,
        reflex=reflex,
        trials=len(group),
        dropped=sum(it.dropped for it in group),
        early=sum(it.early for it in group),
        missed=len(group) - len(done),
        would_drop=len(would),
        prevented=held,
        share=held / len(would) if would else None,
        low=low,
        high=high,
        fallen_mm=float(np.median([it.fallen_mm for it in group])),
        fallen_p95_mm=float(np.percentile([it.fallen_mm for it in group], 95)),
        extra_n=float(np.median(extra)) if extra else None,
        most_extra_n=max(extra, default=None),
        reaction=_medians(parts),
        total_ms=float(np.median([it.total for it in parts])) if parts else None,
        computer_p99_ms=(
            float(np.percentile([it.network + it.command for it in parts], 99)) if parts else None
        ),
    )


def _medians(parts: Sequence[ReactionParts]) -> ReactionParts | None:
    if not parts:
        return None
    return ReactionParts(
        **{name: float(np.median([getattr(it, name) for it in parts])) for name in PARTS}
    )
