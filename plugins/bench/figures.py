"""Figures of a detector in the bench, and the order of the table.

Levels are set on validation scenes alone (`alarms.promised_levels`); `tested` applies them to test
scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sliplab.analysis.detectors.alarms import (
    Level,
    SceneAlarms,
    SceneEvidence,
    false_alarm_rate,
    outcome,
    worlds_of,
)
from sliplab.analysis.detectors.detector import NO_LABEL
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.metrics.intervals import median_interval
from sliplab.plugins.bench.document import (
    BenchDetector,
    BenchPoint,
    BenchScores,
    MedianLatency,
)
from sliplab.storage.schema.evaluation import AlarmRate

RATES = (1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Asked false alarms an hour; the first one is the table's."""


def tested(scenes: Sequence[SceneEvidence], levels: Sequence[Level]) -> tuple[BenchPoint, ...]:
    """Return the scores of test scenes at levels that are set already.

    Test scenes can refute a promise: validation scenes are known to all, and may be remembered.
    """

    def kept(level: Level) -> bool:
        low = false_alarm_rate(scenes, level.value).low
        return level.promised and (low is None or low <= level.asked)

    return tuple(
        BenchPoint(
            asked=level.asked,
            allowed=level.found.alarms,
            level=float(level.value) if np.isfinite(level.value) else None,
            promised=kept(level),
            test=scores(scenes, level.value),
        )
        for level in levels
    )


def scores(scenes: Sequence[SceneEvidence], level: float) -> BenchScores:
    """Return the scores of scenes at a level."""
    outcomes = [outcome(scene, level) for scene in scenes]
    worlds = worlds_of(scenes)
    return BenchScores(
        slides=len(outcomes),
        worlds=len(set(worlds)),
        latency_ms=_median(outcomes, [it.slip.physical_us for it in outcomes], worlds),
        latency_paper_ms=_median(outcomes, [it.slip.paper_us for it in outcomes], worlds),
        missed=sum(it.detected_us is None for it in outcomes),
        early=sum(it.early for it in outcomes),
        false_alarms=false_alarm_rate(scenes, level),
    )


def _median(
    outcomes: Sequence[SceneAlarms], onsets_us: Sequence[int], worlds: Sequence[str]
) -> MedianLatency:
    late = [
        np.inf if it.detected_us is None else (it.detected_us - onset_us) / 1e3
        for it, onset_us in zip(outcomes, onsets_us, strict=True)
    ]
    return median_latency(late, worlds)


def median_latency(late_ms: Sequence[float], worlds: Sequence[str]) -> MedianLatency:
    """Return the median of latencies, infinite where missed, with its interval over worlds."""
    late = np.array(late_ms)
    low, high = median_interval(late, worlds) or (None, None)
    value = float(np.median(late)) if len(late) else None
    return MedianLatency(value=_finite(value), low=_finite(low), high=_finite(high))


def _finite(value: float | None) -> float | None:
    return value if value is not None and np.isfinite(value) else None


def accuracy(scenes: Sequence[SceneEvidence], length_us: int = 30_000) -> float | None:
    """Return the mean recall of the classes, of decisions on scenes; None without classes.

    Args:
        length_us: of the windows that decisions are about: the truth is that in their middle.
    """
    right, every = np.zeros(len(CLASSES)), np.zeros(len(CLASSES))
    for scene in scenes:
        found, slip = scene.evidence, scene.slip
        middle = found.t_us - length_us // 2
        true = (middle >= slip.paper_us).astype(np.int64) + (middle >= slip.gross_us)
        stated = found.label != NO_LABEL
        every += np.bincount(true[stated], minlength=len(CLASSES))
        right += np.bincount(true[stated & (found.label == true)], minlength=len(CLASSES))
    return float((right / every).mean()) if every.all() else None


def ranked(rows: Sequence[BenchDetector]) -> list[BenchDetector]:
    """Return detectors, the best first.

    By the median latency from the physical slip at the table's level. Those that detect less than
    half of the slips have none, and come last, by how many they miss. Of the others, those whose
    test scenes exceed the requested rate of false alarms come after those that do not: the lower
    bound of their rate is above it.
    """

    def key(row: BenchDetector) -> tuple[bool, bool, float, int, float, str]:
        point = row.table
        latency = point.test.latency_ms.value
        low = point.test.false_alarms.low
        broken = low is not None and low > point.asked
        return (
            latency is None,
            latency is not None and broken,
            latency or 0.0,
            point.test.missed,
            point.test.false_alarms.value,
            row.name,
        )

    return sorted(rows, key=key)


def nuisance_scores(
    scenes: Mapping[str, Sequence[SceneEvidence]], level: float
) -> dict[str, BenchScores]:
    """Return the scores at a level by nuisance."""
    return {name: scores(found, level) for name, found in scenes.items()}


def disturbed_rate(scenes: Mapping[str, Sequence[SceneEvidence]], level: float) -> AlarmRate | None:
    """Return false alarms in all scenes with nuisances at a level; None without such scenes."""
    every = [scene for found in scenes.values() for scene in found]
    return false_alarm_rate(every, level) if every else None
