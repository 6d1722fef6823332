"""Differences between the two rules of labelling, and of each from the simulation's truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.storage.schema.evaluation import (
    ChangePointCoverage,
    DeviationByOnset,
    LabelCheck,
    LabelErrors,
    RuleErrors,
    SignedDeviation,
)
from sliplab.storage.schema.label import KINDS, LABELS, Kind, Rule, TrialLabel
from sliplab.storage.schema.summary import HoldSummary
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

REFERENCES = ("hold_start", "hold_end")
CHECK = "label-check"
"""The step that checks labels from drawn video, and the folder of its store."""
_TRUTH: dict[Rule, dict[Kind, str]] = {
    "paper": {"incipient": "incipient_ns", "gross": "gross_ns"},
    "change_point": {"incipient": "first_slip_ns", "gross": "slip_per_papilla_ns"},
}
"""The truth that a rule's onset is compared with: the true crossing, counted from the same end of
the hold, or the true start of the slip in the motion."""


def label_errors(store: TrialStore, campaigns: list[Collected]) -> LabelErrors:
    """Errors of ruling labels against their rule's true onsets, over all simulated trials; ms."""
    rules = {item.settings.labelling.rule for item in campaigns}
    errors: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for rule, kind, label, truth in _cases(store, campaigns):
        onset = label.at_ns(kind)
        if label.rule == rule and onset is not None and truth is not None:
            errors[kind].append((onset - truth) / 1e6)
    return LabelErrors(
        rule="+".join(sorted(rules)),
        incipient=spread(errors["incipient"]),
        gross=spread(errors["gross"]),
    )


def rules_compared(store: TrialStore, campaigns: list[Collected]) -> RuleErrors:
    """Errors of both rules against the truth, and the paper's less the change point's onset, ms."""
    found: dict[str, dict[str, list[float]]] = {
        name: {kind: [] for kind in KINDS} for name in ("paper", "change_point", "apart")
    }
    for rule, kind, label, truth in _cases(store, campaigns):
        mine = label.by_rule(rule).known_ns(kind)
        if mine is not None and truth is not None:
            found[rule][kind].append((mine - truth) / 1e6)
        other = label.by_rule("change_point").known_ns(kind)
        if rule == "paper" and mine is not None and other is not None:
            found["apart"][kind].append((mine - other) / 1e6)
    errors, inside = [], []
    for item in campaigns:
        labels = Derived.of(store, LABELS, item.name)
        for trial, recording in item.trials:
            papillae = (recording.simulation_truth() or {}).get("slip_per_papilla_ns")
            if papillae is None:
                continue
            slips = labels.load(trial.id, TrialLabel).change_point
            if slips is None:
                continue
            for at, low, high, true in zip(
                slips.per_marker_ns, slips.low_ns, slips.high_ns, papillae, strict=True
            ):
                if at != -1 and true is not None:
                    errors.append((at - true) / 1e6)
                    inside.append(low <= true <= high)
    coverage = float(np.mean(inside)) if inside else None
    return RuleErrors(
        **{name: by_onset(kinds) for name, kinds in found.items()},
        papillae=ChangePointCoverage(**dict(spread(errors)), coverage=coverage),
    )


def force_compared(
    store: TrialStore, campaigns: Sequence[Collected]
) -> dict[tuple[str, Kind], list[float]]:
    """Onsets by the force less those of the other rules, and less the true crossing, ms.

    By what they are compared with, in words, and onset; trials without forces are left out.
    """
    apart: dict[tuple[str, Kind], list[float]] = {}
    for item in campaigns:
        labels = Derived.of(store, LABELS, item.name)
        for trial, recording in item.trials:
            if not recording.record.streams or labels.key(trial.id) is None:
                continue
            label = labels.load(trial.id, TrialLabel)
            if label.force is None:
                continue
            truth = recording.simulation_truth() or {}
            rules = {"paper's rule": label.paper, "change point": label.change_point}
            for kind in KINDS:
                mine = label.force.at_ns(kind)
                times = {title: rule.known_ns(kind) for title, rule in rules.items() if rule}
                times["true crossing (simulated)"] = truth.get(_TRUTH["paper"][kind])
                for title, other in times.items():
                    if mine is not None and other is not None:
                        apart.setdefault((title, kind), []).append((mine - other) / 1e6)
    return apart


def holds_compared(store: TrialStore, campaigns: list[Collected]) -> dict[str, HoldSummary]:
    """Slips in the hold by campaign, and how far apart onsets from its two ends are.

    For each campaign `trials`; `slipped`, how many moved by more than `limit_px` (the protocol's
    `analysis.labelling.hold_slip_px`); `most_px`; and `apart_ms`, a spread by kind of the paper's
    onset counted from the hold's end less the one from its start, doubted or not. Labels from
    before they knew both ends are left out.
    """
    found = {}
    for item in campaigns:
        labels = Derived.of(store, LABELS, item.name)
        known = [labels.load(trial.id, TrialLabel) for trial, _ in item.trials]
        known = [label for label in known if label.references is not None]
        if not known:
            continue
        most = [
            max((px for px in label.hold_slip_px if px is not None), default=0.0) for label in known
        ]
        limit = item.settings.labelling.hold_slip_px
        apart: dict[str, list[float]] = {kind: [] for kind in KINDS}
        for label in known:
            for kind in KINDS:
                start, end = ((label.references or {})[at].at_ns(kind) for at in REFERENCES)
                if start is not None and end is not None:
                    apart[kind].append((end - start) / 1e6)
        found[item.name] = HoldSummary(
            trials=len(known),
            slipped=sum(limit is not None and px > limit for px in most),
            limit_px=limit,
            most_px=max(most),
            apart_ms=by_onset(apart),
        )
    return found


def distances(store: TrialStore, campaigns: list[Collected]) -> dict[str, dict[str, list[float]]]:
    """Every trial's distance of each rule's onset from its own truth, ms, by rule and kind.

    Rules of which no truth is known are left out.
    """
    found: dict[str, dict[str, list[float]]] = {}
    for rule, kind, label, truth in _cases(store, campaigns):
        mine = label.by_rule(rule).known_ns(kind)
        if mine is not None and truth is not None:
            kinds = found.setdefault(rule, {name: [] for name in KINDS})
            kinds[kind].append(abs(mine - truth) / 1e6)
    return found


def by_onset(values: Mapping[str, list[float]]) -> DeviationByOnset:
    """Summarise differences of either onset."""
    return DeviationByOnset(incipient=spread(values["incipient"]), gross=spread(values["gross"]))


def spread(values: list[float]) -> SignedDeviation:
    """Summarise differences."""
    there = np.asarray(values)
    return SignedDeviation(
        n=len(values),
        median=float(np.median(there)) if len(there) else None,
        median_abs=float(np.median(np.abs(there))) if len(there) else None,
        max_abs=float(np.max(np.abs(there))) if len(there) else None,
    )


def _cases(
    store: TrialStore, campaigns: list[Collected]
) -> Iterator[tuple[Rule, Kind, TrialLabel, int | None]]:
    """Rule, kind, label and the time that is true of them, or None."""
    for item in campaigns:
        labels = Derived.of(store, LABELS, item.name)
        for trial, recording in item.trials:
            label = labels.load(trial.id, TrialLabel)
            if label.rule == "given":  # nothing here found it
                continue
            for rule in _TRUTH:
                for kind in KINDS:
                    yield rule, kind, label, true_onset_ns(recording, label, rule, kind)


def true_onset_ns(recording: Recording, label: TrialLabel, rule: Rule, kind: Kind) -> int | None:
    """Return the time that is true of a rule's onset in a simulated trial; None where unknown.

    Args:
        rule: `paper`, the true crossing; `change_point`, the true start of the slip.
    """
    truth = recording.simulation_truth()
    if truth is not None and rule == "paper" and label.reference == "hold_start":
        truth = truth.get("from_hold", truth)  # older records have the motion's
    true: int | list[int | None] | None = (truth or {}).get(_TRUTH[rule][kind])
    if isinstance(true, list):
        centre, twists = recording.record.geometry.centre, recording.motion_phase == "twist"
        return _last_other(true, centre) if twists else true[centre]
    return true


def _last_other(times: list[int | None], centre: int) -> int | None:
    """The latest slip of all markers but the centre; None unless each slipped."""
    others = [t for marker, t in enumerate(times) if marker != centre]
    slipped = [t for t in others if t is not None]
    return max(slipped) if slipped and len(slipped) == len(others) else None


def read_check(store: TrialStore) -> LabelCheck | None:
    """Return the figures of the last check; None if there is none."""
    stored = Derived.of(store, CHECK)
    return stored.load(CHECK, LabelCheck) if stored.key(CHECK) is not None else None
