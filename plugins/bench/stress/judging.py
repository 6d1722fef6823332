"""Detectors under nuisances: false alarms in holds, and slips that are detected in time.

A detector gives an alarm when its evidence exceeds its level. It then rests for one second, as long
as an alarm lasts in the bench, and starts again, as it would after a reflex. An alarm earlier than
the label's onset by more than the tolerance is false. The first one after that is the detection; a
slip is missed if none comes before it is gross. The order is by the share of trials with neither a
false alarm nor a missed slip: so a detector that always or never gives an alarm has no clean trial,
and one that guesses few.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt

from sliplab.analysis.detectors.alarms import ALARM_US
from sliplab.analysis.detectors.detectors import DetectionRule, Predictions, first_above
from sliplab.analysis.detectors.latency import TrueSlip, median_with_lost
from sliplab.analysis.metrics.alarm_rates import alarm_rate
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.plugins.bench.stress.document import (
    ALL,
    HourlyRate,
    StressDetector,
    StressFigures,
)
from sliplab.storage.schema.evaluation import Rate


@dataclass(frozen=True)
class StressTrial:
    """A labelled trial under a nuisance; times on its time line, ns.

    Attributes:
        begin_ns: of the recording, in which the sensor holds until the onset.
        slip: by the label.
        true_ns: physical onset; None where it is not known.
    """

    nuisance: str
    strength: float
    begin_ns: int
    slip: TrueSlip
    true_ns: int | None


@dataclass(frozen=True)
class TrialDetection:
    """A detector's result in a trial: false alarms, and the time of a detection in time."""

    false_alarms: int
    detected_ns: int | None


def alarms(
    detector: DetectionRule, level: float, predictions: Predictions
) -> npt.NDArray[np.int64]:
    """Times of all alarms, the ends of their windows, ns, (n,)."""
    found, start = [], 0
    end_ns = predictions.end_ns
    while start < len(end_ns):
        rest = predictions[start:]
        first = first_above(detector.evidence(rest).incipient, level)
        if first is None:
            break
        found.append(int(rest.end_ns[first]))
        start = int(np.searchsorted(end_ns, found[-1] + 1000 * ALARM_US, side="right"))
    return np.array(found, np.int64)


def outcome(at_ns: npt.NDArray[np.int64], slip: TrueSlip, tolerance_ns: int) -> TrialDetection:
    """Judge the alarms of a trial.

    Args:
        at_ns: times of the alarms, ascending, (n,).
        tolerance_ns: an alarm earlier than the label's onset by more is false.
    """
    early = at_ns < slip.incipient_ns - tolerance_ns
    later = at_ns[~early]
    caught = len(later) > 0 and int(later[0]) < slip.gross_ns
    return TrialDetection(int(early.sum()), int(later[0]) if caught else None)


def figures(
    nuisance: str, strength: float | None, trials: Sequence[tuple[StressTrial, TrialDetection]]
) -> StressFigures:
    """Summarise a detector's outcomes."""
    per_hour = alarm_rate(
        [it.false_alarms for _, it in trials],
        [(t.slip.incipient_ns - t.begin_ns) / 3.6e12 for t, _ in trials],
        [(t.nuisance, t.strength) for t, _ in trials],
    )
    clean = sum(it.false_alarms == 0 and it.detected_ns is not None for _, it in trials)
    of_clean = exact_interval(clean, len(trials))
    known = [(t.true_ns, it.detected_ns) for t, it in trials if t.true_ns is not None]
    return StressFigures(
        nuisance=nuisance,
        strength=strength,
        trials=len(trials),
        hold_h=per_hour.hours,
        false_alarms=per_hour.alarms,
        per_hour=HourlyRate(value=per_hour.value, low=per_hour.low, high=per_hour.high),
        clean=Rate(value=clean / len(trials), low=of_clean[0], high=of_clean[1]),
        missed=sum(it.detected_ns is None for _, it in trials),
        latency_ms=_median([(t.slip.incipient_ns, it.detected_ns) for t, it in trials]),
        latency_true_ms=_median(known),
    )


def _median(found: Sequence[tuple[int, int | None]]) -> float | None:
    """Return the median from onsets to detections, ms; None where half of them are missed."""
    there = [(ns - onset_ns) / 1e6 for onset_ns, ns in found if ns is not None]
    return median_with_lost(there, len(found) - len(there), np.inf)


def groups(
    trials: Iterable[StressTrial],
) -> list[tuple[str, float | None, Callable[[StressTrial], bool]]]:
    """Nuisances and strengths in order: all, all strengths of each, each strength of each."""
    there = list(dict.fromkeys((t.nuisance, t.strength) for t in trials))
    found: list[tuple[str, float | None]] = [(ALL, None)]
    for name in dict.fromkeys(name for name, _ in there):
        found.append((name, None))
        found += [(name, s) for s in sorted({s for other, s in there if other == name})]
    return [(name, strength, partial(_belongs, name, strength)) for name, strength in found]


def _belongs(nuisance: str, strength: float | None, trial: StressTrial) -> bool:
    return nuisance in {ALL, trial.nuisance} and strength in {None, trial.strength}


def stressed(
    network: str,
    rule: str,
    stride_ms: int,
    judged: Sequence[tuple[StressTrial, TrialDetection]],
) -> StressDetector:
    """A detector's figures over all trials, each nuisance, and each of its strengths."""
    found = []
    for name, strength, belongs in groups(trial for trial, _ in judged):
        found.append(figures(name, strength, [each for each in judged if belongs(each[0])]))
    return StressDetector(network=network, rule=rule, stride_ms=stride_ms, figures=tuple(found))


def ordered(detectors: Iterable[StressDetector]) -> tuple[StressDetector, ...]:
    """Sort by clean trials, then by false alarms, then by latency from the label's onset."""

    def key(detector: StressDetector) -> tuple[float, ...]:
        over_all = detector.figures[0]
        late = np.inf if over_all.latency_ms is None else over_all.latency_ms
        return -over_all.clean.value, over_all.per_hour.value, late

    return tuple(sorted(detectors, key=key))
