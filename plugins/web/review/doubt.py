"""Uncertainty of a label in numbers: how far a review may move its onsets, or drop the trial.

An onset's spread is a standard deviation. It comes from the 95 % interval that the label states, or
from the frames between which a marker may have crossed the threshold, and from rules that are
further apart than in like trials. An onset in doubt may lie anywhere since the motion began, unless
the doubt is about its interval. A spread of a frame or less counts as zero: no reviewer could do
better.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.event_labels import SLICE_NS, crossing_intervals
from sliplab.analysis.labels.onsets import LabelOnsets as MarkerOnsets
from sliplab.analysis.labels.onsets import last_off_axis
from sliplab.analysis.labels.reviewed import State, label_key, state_of
from sliplab.analysis.labels.slip_times import WIDEST_NS
from sliplab.protocols import PlannedTrial
from sliplab.protocols.shown import plural
from sliplab.storage.schema.label import KINDS, LABELS, Kind, RuleOnsets, TrialLabel
from sliplab.storage.streams import F64, I64
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.review import Decision, ReviewedOnsets, last
from sliplab.storage.trials.store import TrialStore

GRAVE, ODD, SLIGHT = 3, 2, 1
"""An onset in doubt; an onset that is not there; something to look at."""
UNUSABLE = {0: 0.0, SLIGHT: 0.05, ODD: 0.2, GRAVE: 0.5}
"""Assumed share of trials that a review leaves without onsets, by severity of their doubts."""
ASSUMED_TRIALS = 10
"""Reviewed trials that the assumption counts as much as."""
APART_DEVIATIONS = 3.0
"""Rules disagree where they are further apart than this many deviations of similar trials."""
SWEEPS = 5
"""Of the median polish; factors are not balanced in a campaign that still runs."""
_NORMAL = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""


@dataclass(frozen=True)
class ReviewedTrial:
    """A trial with its present label and the last decision on it."""

    item: Collected
    trial: PlannedTrial
    recording: Recording
    label: TrialLabel
    decision: Decision | None

    @property
    def name(self) -> tuple[str, str]:
        """Campaign and trial."""
        return self.item.name, self.trial.id

    @property
    def state(self) -> State:
        """State of the decision."""
        return state_of(self.decision, self.label.key)


@dataclass(frozen=True)
class LabelDoubt:
    """Uncertainty of a trial's label: possible outcomes of its review.

    Attributes:
        onsets: the label's, or those that its rule suggests; None where nothing suggests one.
        end_ns: of the slip.
        spread_ms: standard deviation of either onset about these; 0 if it is at most a frame.
        unusable: probability that a review leaves the trial without onsets.
        severity: of the gravest reason, 0 for none. reasons: as text, gravest first.
    """

    onsets: ReviewedOnsets
    end_ns: int
    spread_ms: Mapping[Kind, float]
    unusable: float
    severity: int
    reasons: tuple[str, ...]

    @property
    def there(self) -> bool:
        """True if a review may find anything else than the label."""
        return self.unusable > 0 or self.severity > 0 or max(self.spread_ms.values()) > 0

    def draw(self, count: int, seed: int) -> tuple[I64, I64, npt.NDArray[np.bool_]]:
        """Return onsets that reviews may find, and in which of them the trial has any.

        Returns:
            incipient and gross onset, ns, and usable; (count,) each.
        """
        rng = np.random.Generator(np.random.PCG64(seed))
        moves, chance = rng.standard_normal((2, count)), rng.random(count)
        start, centre = self.onsets.incipient_ns, self.onsets.gross_ns
        if start is None or centre is None:
            none = np.zeros(count, np.int64)
            return none, none, np.zeros(count, np.bool_)
        incipient, gross = (
            at + np.rint(move * self.spread_ms[kind] * 1e6).astype(np.int64)
            for at, move, kind in zip((start, centre), moves, KINDS, strict=True)
        )
        return incipient, np.maximum(incipient, gross), chance >= self.unusable


def labelled_trials(store: TrialStore, item: Collected) -> list[ReviewedTrial]:
    """Return a campaign's trials whose label is of the trial and settings as they are now.

    Raises:
        StoreError: a label or decision is damaged.
    """
    derived = Derived.of(store, LABELS, item.name)
    return [
        ReviewedTrial(
            item,
            trial,
            recording,
            derived.load(trial.id, TrialLabel),
            last(store, item.name, trial.id),
        )
        for trial, recording in item.trials
        if derived.fresh(trial.id, label_key(recording, item.settings.labelling))
    ]


def reasons_for_doubt(label: TrialLabel) -> list[tuple[int, str]]:
    """Return the reasons to doubt a label, with their severity, gravest first."""
    found: list[tuple[int, str]] = []
    for kind in KINDS:
        if doubt := label.doubts.of(kind):
            found.append((GRAVE, f"{kind}: {doubt}"))
        elif label.at_ns(kind) is None:
            nothing = "no slip was found" if kind == "incipient" else "no gross slip was found"
            found.append((ODD, nothing))
    found += [(ODD, text) for text in label.flags]
    if label.markers_lost:
        found.append((SLIGHT, f"{plural(label.markers_lost, 'time')} a marker was not seen"))
    if label.plate_lost:
        found.append(
            (SLIGHT, f"the plate's marker was not seen in {plural(label.plate_lost, 'frame')}")
        )
    return sorted(dict.fromkeys(found), key=lambda item: -item[0])


def suggested_onsets(label: TrialLabel, centre: int) -> ReviewedOnsets:
    """Return the onsets by the label's rule, in doubt or not.

    Args:
        centre: index of the centre marker, of older labels, which have its time only.
    """
    found = {"paper": label.paper, "change_point": label.change_point}.get(label.rule) or label
    slipped = [time for time in label.per_marker_ns if time >= 0]
    incipient, gross = found.incipient_ns, found.gross_ns
    if incipient is None:
        incipient = min(slipped, default=None)
    if gross is None and centre < len(label.per_marker_ns) and label.per_marker_ns[centre] >= 0:
        gross = label.per_marker_ns[centre]
    return ReviewedOnsets(incipient, gross)


def unusable_shares(cases: Sequence[ReviewedTrial]) -> dict[int, float]:
    """Return the share of trials that a review leaves without onsets, by severity.

    The assumed one, and the decisions so far, each trial as one.
    """
    decided, lost = Counter[int](), Counter[int]()
    for case in cases:
        if case.decision is not None and case.state in {"accepted", "adjusted", "rejected"}:
            severity = _severity(reasons_for_doubt(case.label))
            decided[severity] += 1
            new = case.decision.new
            lost[severity] += new.incipient_ns is None or new.gross_ns is None
    return {
        severity: (ASSUMED_TRIALS * share + lost[severity]) / (ASSUMED_TRIALS + decided[severity])
        for severity, share in UNUSABLE.items()
    }


def doubts_of(
    store: TrialStore, cases: Sequence[ReviewedTrial], unusable: Mapping[int, float]
) -> list[LabelDoubt]:
    """Return the doubt of each label of one campaign.

    Args:
        unusable: share of trials that a review leaves without onsets, by severity.
    """
    every = [suggested_onsets(case.label, case.recording.record.geometry.centre) for case in cases]
    apart = _rules_apart(cases, every)
    found = []
    for number, (case, onsets) in enumerate(zip(cases, every, strict=True)):
        reasons = reasons_for_doubt(case.label)
        texts = [text for _, text in reasons]
        spread = _spreads_ms(store, case, onsets)
        resolution_ms = _frame_ms(case)
        for kind in KINDS:
            excess, other = apart.get((number, kind), (0.0, ""))
            if spread[kind] > resolution_ms and not case.label.doubts.of(kind):
                texts.append(f"{kind}: only known to +-{2 * spread[kind]:.0f} ms (95 %)")
            if excess > resolution_ms:
                texts.append(f"{kind}: {other} is {excess:.0f} ms further off than in like trials")
            spread[kind] = max(spread[kind], excess)
            if spread[kind] <= resolution_ms:
                spread[kind] = 0.0
        severity = _severity(reasons)
        found.append(
            LabelDoubt(
                onsets, case.label.end_ns, spread, unusable[severity], severity, tuple(texts)
            )
        )
    return found


def _severity(reasons: Sequence[tuple[int, str]]) -> int:
    return reasons[0][0] if reasons else 0


def _frame_ms(case: ReviewedTrial) -> float:
    """Return the interval of two frames, or of the slices that replace them; 0 without either."""
    record = case.recording.record
    if record.counts.frames and record.recorded_s:
        return 1000 * record.recorded_s / record.counts.frames
    return SLICE_NS / 1e6 if case.label.source == "events" else 0.0


def _spreads_ms(
    store: TrialStore, case: ReviewedTrial, onsets: ReviewedOnsets
) -> dict[Kind, float]:
    """Standard deviation of either onset by its own interval, or in doubt since the motion."""
    label, found = case.label, dict[Kind, float]()
    intervals = _stated(case) or _crossed(store, case)
    began = {"incipient": case.recording.motion_ns[0], "gross": onsets.incipient_ns}
    for kind, at in zip(KINDS, (onsets.incipient_ns, onsets.gross_ns), strict=True):
        low, high = intervals.get(kind) or (0, 0)
        found[kind] = (high - low) / 4e6  # the central 95 % are four deviations
        start = began[kind]
        narrow = high - low <= WIDEST_NS
        if label.doubts.of(kind) and narrow and start is not None and at is not None:
            found[kind] = abs(at - start) / 1e6 / float(np.sqrt(12))
    return found


def _stated(case: ReviewedTrial) -> dict[Kind, tuple[int, int] | None]:
    """Return the central 95 % of the onsets that the label itself states, ns."""
    label, slips = case.label, case.label.change_point
    if label.rule == "change_point" and slips is not None:
        markers = (slips.first_marker, _centre(case, slips))
        ends = [None if m is None else (slips.low_ns[m], slips.high_ns[m]) for m in markers]
        return dict(zip(KINDS, ends, strict=True))
    if label.rule in {"paper", "given"} and label.intervals is not None:
        return {"incipient": label.intervals.incipient_ns, "gross": label.intervals.gross_ns}
    return {}


def _crossed(store: TrialStore, case: ReviewedTrial) -> dict[Kind, tuple[int, int] | None]:
    """Return when markers in frames, give or take two deviations, cross the paper's threshold."""
    label, settings = case.label, case.item.settings.labelling
    if label.rule != "paper" or label.paper is None or label.doubts.incipient:
        return {}
    stored = Derived.of(store, LABELS, case.item.name)
    arrays = stored.arrays(case.trial.id, "frame_ns", "displacement_px", "sigma_px")
    frame_ns, start_ns = arrays["frame_ns"], case.recording.motion_ns[0]
    if label.reference == "hold_start":
        start_ns = int(frame_ns[0])
    found = crossing_intervals(
        frame_ns,
        arrays["displacement_px"],
        arrays["sigma_px"],
        _marker_onsets(label.paper),
        _centre(case, label.paper),
        settings.threshold_px,
        start_ns - 1,
    )
    return {"incipient": found.incipient_ns, "gross": found.gross_ns}


def _marker_onsets(found: RuleOnsets) -> MarkerOnsets:
    times = np.asarray(found.per_marker_ns, np.int64)
    return MarkerOnsets(found.incipient_ns, found.gross_ns, found.first_marker, times)


def _centre(case: ReviewedTrial, found: RuleOnsets) -> int:
    """Return the marker whose slip is the gross onset."""
    centre = case.recording.record.geometry.centre
    twists = case.recording.motion_phase == "twist"
    return last_off_axis(_marker_onsets(found), centre) if twists else centre


def _rules_apart(
    cases: Sequence[ReviewedTrial], onsets: Sequence[ReviewedOnsets]
) -> dict[tuple[int, Kind], tuple[float, str]]:
    """Return the excess distance of rules over that in similar trials, ms, and the rule.

    By case and onset, of the rule that is furthest.

    Args:
        onsets: by the rule of each label.
    """
    found: dict[tuple[int, Kind], tuple[float, str]] = {}
    others = [_other_rules(case.label) for case in cases]
    conditions = [case.item.describe(case.trial) for case in cases]
    for kind in KINDS:
        for name in dict.fromkeys(name for rules in others for name in rules):
            apart = np.full(len(cases), np.nan)
            for number, (mine, rules) in enumerate(zip(onsets, others, strict=True)):
                at = getattr(mine, f"{kind}_ns")
                other = rules[name].known_ns(kind) if name in rules else None
                if at is not None and other is not None:
                    apart[number] = (other - at) / 1e6
            left = np.abs(without_levels(apart, conditions))
            if not np.isfinite(left).any():
                continue
            excess = left - APART_DEVIATIONS * _NORMAL * np.nanmedian(left)
            for number in np.flatnonzero(excess > 0).tolist():
                worst = (float(excess[number]), name)
                found[number, kind] = max(found.get((number, kind), worst), worst)
    return found


def _other_rules(label: TrialLabel) -> dict[str, RuleOnsets]:
    """Return the onsets by rules other than the label's own, by name."""
    rules = {"paper": label.paper, "change_point": label.change_point, "force": label.force}
    words = {"paper": "the paper's rule", "change_point": "the change point", "force": "the force"}
    found = {words[name]: rule for name, rule in rules.items() if rule and name != label.rule}
    end = "hold_end" if label.reference == "hold_start" else "hold_start"
    if label.rule == "paper" and label.references and end in label.references:
        found["the other end of the hold"] = label.references[end]
    return found


def without_levels(values: F64, conditions: Sequence[Mapping[str, str]]) -> F64:
    """Return what the levels of the factors leave of values, by Tukey's median polish.

    The median of all values is taken out, then in turns that of the values at each level.

    Args:
        values: (n,), NaN where unknown. conditions: level by factor of each.
    """
    if not np.isfinite(values).any():
        return values
    left = values - np.nanmedian(values)
    factors = dict.fromkeys(name for condition in conditions for name in condition)
    levels = [np.array([condition.get(name, "") for condition in conditions]) for name in factors]
    groups = [of == level for of in levels for level in np.unique(of)]
    for there in groups * SWEEPS:
        if np.isfinite(left[there]).any():
            left[there] -= np.nanmedian(left[there])
    return left
