"""All detectors at equal rates of false early detections: the report's comparison.

Detectors are fitted on training trials, their thresholds are set on validation trials to the same
number of false early detections, and they are evaluated on test trials, which select nothing.
The numbers are small (a percent of 130 trials is one trial), so each rate has its exact interval.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from sliplab.analysis.detectors.alarms import (
    Level,
    SceneEvidence,
    false_alarm_rate,
    promised_levels,
)
from sliplab.analysis.detectors.detector import Evidence, Slip
from sliplab.analysis.detectors.detectors import (
    DetectionRule,
    Learned,
    Levels,
    Smoothing,
    TrialWithSlip,
    Tuned,
    WindowEvidence,
    decide,
    first_above,
    learn,
)
from sliplab.analysis.detectors.latency import (
    TrueSlip,
    score_trial,
    summarise_latency,
    summarise_lead,
)
from sliplab.analysis.detectors.onset_references import (
    Decided,
    References,
    judge_by_reference,
    still_until_ns,
)
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.protocols.detection import ComparisonSettings, Detection
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.evaluation import (
    AlarmRate,
    CurvePoint,
    DetectorComparison,
    DetectorLevels,
    DetectorRate,
    DetectorScores,
    DetectorTrials,
    OnsetFigures,
    PartTrials,
    Rate,
    TrialLatency,
)


@dataclass(frozen=True)
class TrialEvidence:
    """A trial's evidence with its label's onsets, and those by other references."""

    evidence: WindowEvidence
    slip: TrueSlip
    references: References = field(default_factory=dict)


def judge(detector: DetectionRule, trials: Sequence[TrialWithSlip]) -> list[TrialEvidence]:
    """Evidence of a detector on labelled trials."""
    return [TrialEvidence(detector.evidence(t.predictions), t.slip, t.references) for t in trials]


def allowed_early(rate: float, trials: int) -> int:
    """Number of trials that may be false early: the whole number not above their share."""
    return int(np.floor(rate * trials + 1e-9))


def set_levels(trials: Sequence[TrialEvidence], allowed: int, false_early_ns: int) -> Levels:
    """The lowest levels at which at most `allowed` trials are false early, for either onset.

    A level is the evidence that the trial after the allowed ones had before its onset; so it is
    found exactly, and a lower one would let that trial through. The gross level is found with the
    incipient one in force.

    Raises:
        ValueError: not more trials than are allowed to be false: nothing would bound a level.
    """
    if not 0 <= allowed < len(trials):
        raise ValueError(f"{allowed} of {len(trials)} trials may be false early: no bound")
    highest = [
        _highest(t.evidence.incipient, t.evidence, 0, t.slip.incipient_ns - false_early_ns)
        for t in trials
    ]
    incipient = sorted(highest, reverse=True)[allowed]
    return Levels(incipient, _gross_level(trials, incipient, allowed, false_early_ns))


def _gross_level(
    trials: Sequence[TrialEvidence], incipient: float, allowed: int, false_early_ns: int
) -> float:
    highest = []
    for t in trials:
        first = first_above(t.evidence.incipient, incipient)
        if first is None:
            highest.append(-np.inf)
            continue
        gross = t.evidence.gross_after(first)
        highest.append(_highest(gross, t.evidence, first + 1, t.slip.gross_ns - false_early_ns))
    return sorted(highest, reverse=True)[allowed]


def _highest(values: Any, evidence: WindowEvidence, start: int, before_ns: int) -> float:
    """The highest value of windows from `start` on that end before a moment; -inf without any."""
    stop = int(np.searchsorted(evidence.end_ns, before_ns, side="left"))
    return float(values[start:stop].max(initial=-np.inf))


def scenes_of(trials: Sequence[TrialEvidence], false_early_ns: int) -> list[SceneEvidence]:
    """Return trials as scenes that begin with their first window's end.

    They are still until `still_until_ns`.
    """
    found = []
    for trial in trials:
        end_ns, slip = trial.evidence.end_ns, trial.slip
        begin_ns = int(end_ns[0]) if len(end_ns) else slip.incipient_ns
        still_ns = still_until_ns(slip, trial.references, false_early_ns)
        still_us = max(still_ns - begin_ns, 0) // 1000
        onset_us, gross_us = ((at - begin_ns) // 1000 for at in (slip.incipient_ns, slip.gross_ns))
        evidence = Evidence.of((end_ns - begin_ns) // 1000, trial.evidence.incipient)
        found.append(SceneEvidence(evidence, Slip(still_us, onset_us, gross_us)))
    return found


def outcomes(
    trials: Sequence[TrialEvidence], levels: Levels, false_early_ns: int
) -> list[TrialLatency]:
    """Each trial's detections against its label's onsets."""
    return [score_trial(decide(t.evidence, levels), t.slip, false_early_ns) for t in trials]


def merit(scored: Sequence[TrialLatency]) -> tuple[float, float]:
    """Median and 95th percentile incipient latency, ms; a missed or late one counts as infinite.

    So a detector cannot better its median by missing what is hard. False early trials are left
    out: they are bounded apart.
    """
    late = [
        np.inf if t.latency_incipient_ms is None else t.latency_incipient_ms
        for t in scored
        if not t.false_early_incipient
    ]
    if not late:
        return np.inf, np.inf
    ordered = np.sort(np.asarray(late, np.float64))
    # between two values a percentile of infinite ones would be no number
    return float(np.median(ordered)), float(np.percentile(ordered, 95, method="inverted_cdf"))


CURVE_RATE = 0.06
"""The curves end at this share of false early validation trials."""


@dataclass(frozen=True)
class Parts:
    """Trials with both onsets: training ones in consecutive windows, the others at the finer
    stride."""

    train: Sequence[TrialWithSlip]
    validation: Sequence[TrialWithSlip]
    test: Sequence[TrialWithSlip]


def compare(
    parts: Parts, settings: AnalysisSettings, detection: Detection
) -> DetectorComparison | None:
    """Compare every detector at every stride and rate.

    Args:
        settings: windows and their finer stride, which divides their length.
        detection: smoothing of the paper's rule, the grid of smoothings, what is false early, and
            the rates that are compared.

    Returns:
        None where nothing is to be compared, or training, validation or test trials are missing.
    """
    asked, fine_ms = detection.compare, settings.fine_stride_ms
    if asked is None or fine_ms is None or not (parts.train and parts.validation and parts.test):
        return None
    length_ms = settings.windows.length_ms
    learned = _learned(parts, settings)
    found = []
    for stride in sorted({length_ms, fine_ms}, reverse=True):
        every = stride // fine_ms
        validation = [thinned(trial, every) for trial in parts.validation]
        test = [thinned(trial, every) for trial in parts.test]
        for name, choices in _detectors(learned, settings, detection, stride).items():
            judged = {
                key: (judge(detector, validation), judge(detector, test))
                for key, detector in choices.items()
            }
            rates, curve = _scores(judged, detection, asked)
            found.append(DetectorScores(name=name, stride_ms=stride, rates=rates, curve=curve))
    return DetectorComparison(
        trials=PartTrials(
            train=len(parts.train), validation=len(parts.validation), test=len(parts.test)
        ),
        strides_ms=tuple(sorted({length_ms, fine_ms})),
        detectors=tuple(found),
    )


def thinned(trial: TrialWithSlip, every: int) -> TrialWithSlip:
    """A trial with each `every`-th of its windows, the first one among them."""
    return replace(trial, predictions=trial.predictions[::every])


def _learned(parts: Parts, settings: AnalysisSettings) -> Learned:
    return learn(parts.train, settings.windows.length_ms * 1_000_000, settings.most_spikes)


@dataclass(frozen=True)
class PromisedRule:
    """A rule whose incipient level validation trials set by a promise, with its test figures.

    Attributes:
        level: of the incipient evidence.
        test: false alarms on test trials; None without any.
        median_ms: incipient latency on them, a missed one infinite; None if so.
    """

    rule: Tuned
    level: Level
    test: AlarmRate | None
    median_ms: float | None


def tuned(parts: Parts, settings: AnalysisSettings, detection: Detection) -> list[Tuned]:
    """Fit every detector at the finer stride, at the middle of the rates that are compared.

    Args:
        settings, detection: see `compare`.

    Returns:
        none where nothing is to be compared, or training or validation trials are missing.
    """
    tolerance = round(detection.false_early_ms * 1e6)
    found = []
    for name, choices, judged, allowed in _judged(parts, settings, detection):
        levels = {key: set_levels(trials, allowed, tolerance) for key, trials in judged.items()}
        key = _quickest(judged, levels, tolerance)
        found.append(Tuned(name, choices[key], levels[key]))
    return found


def promised(
    parts: Parts, settings: AnalysisSettings, detection: Detection, promise: float
) -> list[PromisedRule]:
    """Fit every detector at the finer stride, at a promise of false alarms.

    The choice among several of a detector is made after their levels, by the same trials; each
    level keeps its promise with 95 % alone. Gross slip has the level that `tuned` gives it.

    Args:
        settings, detection: see `compare`.
        promise: false alarms an hour without slip, at most.

    Returns:
        as `tuned`.
    """
    tolerance = round(detection.false_early_ms * 1e6)
    found = []
    for name, choices, judged, allowed in _judged(parts, settings, detection):
        set_by, levels = {}, {}
        for key, trials in judged.items():
            (level,) = promised_levels(scenes_of(trials, tolerance), [promise])
            gross = _gross_level(trials, level.value, allowed, tolerance)
            set_by[key], levels[key] = level, Levels(level.value, gross)
        key = _quickest(judged, levels, tolerance)
        level, test = set_by[key], judge(choices[key], parts.test)
        found.append(
            PromisedRule(
                Tuned(name, choices[key], levels[key]),
                level,
                false_alarm_rate(scenes_of(test, tolerance), level.value) if test else None,
                _plain(merit(outcomes(test, levels[key], tolerance))[0]),
            )
        )
    return found


def _judged(
    parts: Parts, settings: AnalysisSettings, detection: Detection
) -> Iterator[tuple[str, dict[int, DetectionRule], dict[int, list[TrialEvidence]], int]]:
    """Yield each detector's name, its choices, and their evidence on validation trials.

    The last value is how many of these may be false early, by the middle of the rates.
    """
    asked, fine_ms = detection.compare, settings.fine_stride_ms
    if asked is None or fine_ms is None or not (parts.train and parts.validation):
        return
    allowed = allowed_early(asked.rates[len(asked.rates) // 2], len(parts.validation))
    detectors = _detectors(_learned(parts, settings), settings, detection, fine_ms)
    for name, choices in detectors.items():
        judged = {key: judge(it, parts.validation) for key, it in choices.items()}
        yield name, choices, judged, allowed


def _quickest(
    judged: Mapping[int, Sequence[TrialEvidence]], levels: Mapping[int, Levels], tolerance: int
) -> int:
    """Of several choices of a detector the one that validation trials find quickest."""
    return min(judged, key=lambda key: (*merit(outcomes(judged[key], levels[key], tolerance)), key))


def _detectors(
    learned: Learned, settings: AnalysisSettings, detection: Detection, stride_ms: int
) -> dict[str, dict[int, DetectionRule]]:
    """Detectors by name; where there are several, the validation trials choose, by the number."""
    ours = learned.detectors(stride_ms / settings.windows.length_ms)
    return {
        "smoothing": {detection.smoothing: Smoothing(detection.smoothing)},
        "smoothing chosen": {width: Smoothing(width) for width in detection.smoothing_grid},
        **{name: {0: detector} for name, detector in ours.items()},
    }


def _scores(
    judged: Mapping[int, tuple[list[TrialEvidence], list[TrialEvidence]]],
    settings: Detection,
    asked: ComparisonSettings,
) -> tuple[tuple[DetectorRate, ...], tuple[CurvePoint, ...]]:
    tolerance = round(settings.false_early_ms * 1e6)
    trials = len(next(iter(judged.values()))[0])
    known: dict[int, _AtRate] = {}

    def at(allowed: int) -> _AtRate:
        if allowed not in known:
            known[allowed] = _best(judged, allowed, tolerance)
        return known[allowed]

    rates = tuple(
        DetectorRate(asked=rate, allowed=allowed, **vars(at(allowed)))
        for rate in asked.rates
        for allowed in (allowed_early(rate, trials),)
    )
    last = min(allowed_early(CURVE_RATE, trials), trials - 1)
    curve = tuple(
        CurvePoint(
            allowed=allowed,
            rate=allowed / trials,
            median_ms=at(allowed).test.median_with_missed_ms,
        )
        for allowed in range(last + 1)
    )
    return rates, curve


@dataclass(frozen=True)
class _AtRate:
    """One detector at one rate."""

    choice: int
    levels: DetectorLevels
    validation: DetectorTrials
    test: DetectorTrials
    by_reference: dict[str, OnsetFigures]


def _best(
    judged: Mapping[int, tuple[list[TrialEvidence], list[TrialEvidence]]],
    allowed: int,
    tolerance: int,
) -> _AtRate:
    """One detector at one rate."""
    validations = {key: validation for key, (validation, _) in judged.items()}
    every = {key: set_levels(found, allowed, tolerance) for key, found in validations.items()}
    key = _quickest(validations, every, tolerance)
    levels = every[key]
    of_validation, of_test = (
        _summary(trials, outcomes(trials, levels, tolerance), levels) for trials in judged[key]
    )
    plain = {name: _plain(value) for name, value in vars(levels).items()}
    tested = [Decided(decide(t.evidence, levels), t.references, tolerance) for t in judged[key][1]]
    figures = judge_by_reference(tested)
    return _AtRate(key, DetectorLevels(**plain), of_validation, of_test, figures)


def _summary(
    trials: Sequence[TrialEvidence], scored: Sequence[TrialLatency], levels: Levels
) -> DetectorTrials:
    early = sum(trial.false_early_incipient for trial in scored)
    low, high = exact_interval(early, len(scored))
    before = []
    for trial, score in zip(trials, scored, strict=True):
        found = decide(trial.evidence, levels).incipient_ns
        if score.false_early_incipient and found is not None:
            before.append((trial.slip.incipient_ns - found) / 1e6)
    return DetectorTrials(
        false_early_before_ms=tuple(sorted(before)),
        false_early_rate=Rate(value=early / len(scored), low=low, high=high),
        median_with_missed_ms=_plain(merit(scored)[0]),
        latency_ms=summarise_latency(scored),
        lead_ms=summarise_lead(scored),
    )


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
