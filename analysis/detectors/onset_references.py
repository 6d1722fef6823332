"""The same decisions by several onsets: the paper's, the change point, and the true one.

The paper's rule dates an onset when a marker has moved by 2 pixels, some time after it began to
slip. A detection between the two is false early by the one and has a latency by the other. So
decisions that were made once, at levels set by the label, are judged by each onset with the
function that scores them by the label, `latency.score_trial`. Only simulated trials have a true
onset; it is used for scoring only, not for levels, choices or training.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sliplab.analysis.detectors.latency import (
    DetectedOnsets,
    TrueSlip,
    is_false_early,
    median_span,
    score_trial,
    slip_of,
    summarise_latency,
)
from sliplab.analysis.labels.label_errors import true_onset_ns
from sliplab.analysis.metrics.intervals import exact_interval
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import OnsetFigures, Rate, TrialLatency, TrialScore
from sliplab.storage.schema.label import KINDS, Kind, RuleOnsets, TrialLabel
from sliplab.storage.trials.recording import Recording

VERSION = 2
Name = Literal["paper", "change_point", "true"]
NAMES: tuple[Name, ...] = ("paper", "change_point", "true")
"""`true`: the tips' physical start of sliding, of simulated trials alone."""


@dataclass(frozen=True)
class OnsetReference:
    """A trial's slip by one reference.

    Attributes:
        interval_ns: central 95 % of the incipient onset; None where it is not stated.
    """

    slip: TrueSlip
    interval_ns: tuple[int, int] | None = None


References = Mapping[Name, OnsetReference]
"""A trial's references; those that lack an onset are absent."""


@dataclass(frozen=True)
class Decided:
    """The decisions on one trial, its references, and the tolerance that its protocol asks for."""

    found: DetectedOnsets
    references: References
    false_early_ns: int

    def latency(self, name: Name) -> TrialLatency | None:
        """Judge the decisions by a reference; None where it lacks an onset."""
        reference = self.references.get(name)
        if reference is None:
            return None
        return score_trial(self.found, reference.slip, self.false_early_ns)


def references_of(recording: Recording, label: TrialLabel) -> References:
    """Return the slips of a trial by each reference; onsets in doubt are lacking.

    Args:
        label: as later steps read it; its own rule is taken with people's decisions.
    """
    found: dict[Name, OnsetReference] = {}
    rules: dict[Name, RuleOnsets | None] = {
        "paper": label.paper,
        "change_point": label.change_point,
    }
    for name, onsets in rules.items():
        if label.rule == name:
            slip = slip_of(label.incipient_ns, label.gross_ns, label.end_ns)
        elif onsets is not None:
            slip = slip_of(onsets.known_ns("incipient"), onsets.known_ns("gross"), label.end_ns)
        else:
            continue
        if slip is not None:
            interval_ns = _interval(label, slip) if name == "change_point" else None
            found[name] = OnsetReference(slip, interval_ns)
    incipient, gross = (true_onset_ns(recording, label, "change_point", kind) for kind in KINDS)
    if (slip := slip_of(incipient, gross, label.end_ns)) is not None:
        found["true"] = OnsetReference(slip)
    return found


def _interval(label: TrialLabel, slip: TrueSlip) -> tuple[int, int] | None:
    """Return the interval of a change point; None where a person set another onset."""
    points = label.change_point
    if points is None or points.incipient_ns != slip.incipient_ns or not points.low_ns:
        return None
    first = points.first_marker
    return None if first is None else (points.low_ns[first], points.high_ns[first])


def still_until_ns(slip: TrueSlip, references: References, false_early_ns: int) -> int:
    """Return the moment up to which surely nothing slipped: alarms before it are false.

    It is the lower end of the change point's interval, since a tip slides before a marker has moved
    by 2 pixels; at the latest the label's onset less the tolerance.
    """
    latest_ns = slip.incipient_ns - false_early_ns
    point = references.get("change_point")
    if point is None:
        return latest_ns
    low_ns = point.slip.incipient_ns if point.interval_ns is None else point.interval_ns[0]
    return min(low_ns, latest_ns)


def decisions_of(
    rows: Sequence[TrialScore],
    references: Mapping[tuple[str, str], References],
    rules: Mapping[str, Detection],
) -> list[Decided]:
    """Return the decisions of an evaluation's trials.

    Args:
        references: by campaign and trial. rules: of detection, by campaign.
    """
    return [
        Decided(
            DetectedOnsets(row.detected_incipient_ns, row.detected_gross_ns),
            references.get((row.campaign, row.trial), {}),
            round(rules[row.campaign].false_early_ms * 1e6),
        )
        for row in rows
    ]


def judge_by_reference(decisions: Sequence[Decided]) -> dict[str, OnsetFigures]:
    """Judge the same decisions by each reference.

    Both rules have their figures, though all trials may lack the onsets of one; without any
    reference there are none, and true onsets have figures only where a trial has them.
    """
    known = {name for decided in decisions for name in decided.references}
    shown = [name for name in NAMES if name in known or (known and name != "true")]
    return {name: _figures(decisions, name) for name in shown}


def _figures(decisions: Sequence[Decided], name: Name) -> OnsetFigures:
    there = [(each, each.references[name]) for each in decisions if name in each.references]
    scored = [times for each in decisions if (times := each.latency(name)) is not None]
    early = sum(trial.false_early_incipient for trial in scored)
    low, high = exact_interval(early, len(scored))
    by_paper = [
        found >= ours.slip.incipient_ns
        for each, ours in there
        if (found := each.found.incipient_ns) is not None
        and (paper := each.references.get("paper")) is not None
        and is_false_early(found, paper.slip.incipient_ns, each.false_early_ns)
    ]
    spans = [(each, ours.interval_ns) for each, ours in there if ours.interval_ns is not None]
    unsure = [
        len({is_false_early(found, end, each.false_early_ns) for end in span}) > 1
        for each, span in spans
        if (found := each.found.incipient_ns) is not None
    ]
    return OnsetFigures(
        trials=len(there),
        lacking=len(decisions) - len(there),
        latency_ms=summarise_latency(scored),
        median_incipient_ms=_median_span(scored, "incipient"),
        median_gross_ms=_median_span(scored, "gross"),
        false_early_rate=Rate(value=early / len(scored), low=low, high=high) if scored else None,
        early_by_paper=len(by_paper),
        not_before=sum(by_paper),
        width_ms=float(np.median([b - a for _, (a, b) in spans])) / 1e6 if spans else None,
        unsure=sum(unsure),
    )


def _median_span(
    scored: Sequence[TrialLatency], kind: Kind
) -> tuple[float | None, float | None] | None:
    values = [getattr(trial, f"latency_{kind}_ms") for trial in scored]
    lost = sum(trial.uncounted[2 if kind == "incipient" else 3] for trial in scored)
    return median_span([value for value in values if value is not None], lost, np.inf)
