"""What became of every planned trial: each is in one place, and all of them add up to the plan.

A mean over detected trials says nothing of those that were not. So every trial of the plan that is
there to be judged is counted once: not taken, taken after the evaluation, without onsets in its
label, false early, missed, detected late (when gross slip had begun), or detected first.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.metrics.intervals import interval

Json = dict[str, Any]

OUTCOMES = (
    "detected_first", "late", "missed", "false_early", "without_onsets", "not_evaluated",
    "not_taken",
)  # fmt: skip
"""Every judged trial of a plan has exactly one."""

WORDS = {
    "detected_first": "detected before gross slip",
    "late": "detected late, after gross slip began",
    "missed": "missed",
    "false_early": "false early",
    "without_onsets": "no onset in the label",
    "not_evaluated": "taken after the evaluation",
    "not_taken": "not taken",
}
VALUES = ("duration_ms", "latency_incipient_ms", "latency_gross_ms", "lead_ms")
LATE = ("late_incipient_ms", "late_gross_ms")
"""By how much a late detection came after its event."""


def outcome(row: Json) -> str:
    """What became of one evaluated trial, by its incipient detection."""
    found = row["latency"]
    if found is None:
        return "without_onsets"
    return _verdict(found, "incipient", "detected_first")


def trial_summary(row: Json) -> Json:
    """Summarise one evaluated trial."""
    found = row["latency"] or {}
    length = None
    if row["latency"] is not None:
        length = (row["gross_ns"] - row["incipient_ns"]) / 1e6
    return {
        "campaign": row["campaign"],
        "experiment": row["experiment"],
        "trial": row["trial"],
        "outcome": outcome(row),
        "gross": _gross(row),
        "duration_ms": length,
        **{name: found.get(name) for name in (*VALUES[1:], *LATE)},
    }


def _gross(row: Json) -> str:
    found = row["latency"]
    return "without_onsets" if found is None else _verdict(found, "gross", "detected")


def _verdict(found: Json, kind: str, counted: str) -> str:
    """Outcome of one of a trial's detections."""
    if found[f"missed_{kind}"]:
        return "missed"
    if found[f"false_early_{kind}"]:
        return "false_early"
    return counted if found[f"late_{kind}_ms"] is None else "late"


def accounted(campaigns: Sequence[Collected], rows: Sequence[Json], experiment: str) -> Json:
    """Every trial that an experiment's plans want judged, by what became of it.

    Args:
        rows: of the evaluation.

    Returns:
        ``planned``, and a count for each of `OUTCOMES`; these add up to it.
    """
    judged = {(row["campaign"], row["trial"]): outcome(row) for row in rows}
    counts: Counter[str] = Counter()
    for item in campaigns:
        if item.experiment == experiment:
            there = {trial.id for trial, _ in item.trials}
            for trial in item.plan:
                if trial.split == "test":
                    other = "not_evaluated" if trial.id in there else "not_taken"
                    counts[judged.get((item.name, trial.id), other)] += 1
    return {"planned": counts.total(), **{name: counts[name] for name in OUTCOMES}}


def intervals(rows: Sequence[Json]) -> dict[str, Json]:
    """By value of a trial: n, mean, median and 95th percentile, each with its interval over trials.

    Args:
        rows: from `trial_summary`.
    """
    found = {}
    for name in VALUES:
        there = [row[name] for row in rows if row[name] is not None]
        spans = {kind: interval(there, kind) for kind in ("mean", "median", "p95")}
        found[name] = {
            "n": len(there),
            **{kind: None if span is None else list(span) for kind, span in spans.items()},
        }
    return found


class Conditions:
    """Evaluated trials of one experiment by condition, in the order of the factors' levels.

    Args:
        rows: of the evaluation.
    """

    def __init__(
        self, campaigns: Sequence[Collected], rows: Sequence[Json], experiment: str
    ) -> None:
        self.factors: dict[str, list[str]] = {}
        self.campaigns = {item.name for item in campaigns if item.experiment == experiment}
        for item in campaigns:
            factors = item.plan.protocol.collection.factors
            for name, levels in item.plan.enabled.items() if item.name in self.campaigns else ():
                there = self.factors.setdefault(name, [])
                there += [t for t in map(factors[name].text, levels) if t not in there]
        self.rows = [
            {**trial_summary(row), "condition": row["condition"]}
            for row in rows
            if row["campaign"] in self.campaigns
        ]

    def varied(self) -> list[str]:
        """The factors with several levels, or all if none has."""
        several = [name for name, levels in self.factors.items() if len(levels) > 1]
        return several or list(self.factors)

    def level(self, factor: str, text: str) -> list[Json]:
        """The trials with this level."""
        return [row for row in self.rows if row["condition"].get(factor) == text]

    def cells(self, factors: Sequence[str]) -> dict[str, list[Json]]:
        """The trials by all pairs (or singles) of levels, named ``0.165 kg, 0.3 mm/s``."""
        cells = {}
        for levels in itertools.product(*(self.factors[name] for name in factors)):
            wanted = dict(zip(factors, levels, strict=True))
            cells[", ".join(levels)] = [
                row
                for row in self.rows
                if all(row["condition"].get(name) == text for name, text in wanted.items())
            ]
        return cells

    def breaks(self, factors: Sequence[str]) -> list[int]:
        """Rows of `cells` at which the first factor's level changes."""
        step = math.prod(len(self.factors[name]) for name in factors[1:])
        if step < 2:
            return []
        return [step * k for k in range(1, len(self.factors[factors[0]]))]


def values(rows: Sequence[Mapping[str, Any]], name: str) -> list[float]:
    """One of `VALUES` of every trial that has it."""
    return [float(row[name]) for row in rows if row[name] is not None]
