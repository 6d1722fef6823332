"""Outcomes of trials: every trial has exactly one, and they add up to the plan.

A mean over detected trials says nothing about the others. So every trial of the plan that is
meant for evaluation is counted once: not taken, taken after the evaluation, without onsets in its
label, false early, missed, detected late (when gross slip had begun), or detected first.
"""

from __future__ import annotations

import itertools
import math
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, get_args

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.latency import median_span
from sliplab.analysis.metrics.intervals import interval
from sliplab.analysis.report.page import Content, Table, number
from sliplab.protocols.detection import Detection
from sliplab.storage.schema.evaluation import TrialLatency, TrialScore
from sliplab.storage.schema.summary import (
    Accounts,
    Outcome,
    RuleSettings,
    Span,
    TimeIntervals,
    TrialIntervals,
    TrialOutcome,
)

Rule = Detection | RuleSettings
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
WORDS = {
    "detected_first": "detected before gross slip",
    "late": "detected late, after gross slip began",
    "missed": "missed",
    "false_early": "false early",
    "without_onsets": "no onset in the label",
    "not_evaluated": "taken after the evaluation",
    "not_taken": "not taken",
}
TIMES = ("duration_ms", "latency_incipient_ms", "latency_gross_ms", "lead_ms")
"""Times of a trial."""
CAUSE = {"latency_incipient_ms": "outcome", "lead_ms": "outcome", "latency_gross_ms": "gross"}
"""Key of a trial that gives the reason for a missing time."""


def trial_outcome(row: TrialScore) -> TrialOutcome:
    """Summarise one evaluated trial.

    Args:
        row: of the evaluation.
    """
    found = row.latency
    times = (*TIMES[1:], "late_incipient_ms", "late_gross_ms")
    length = None
    if found is not None and row.gross_ns is not None and row.incipient_ns is not None:
        length = (row.gross_ns - row.incipient_ns) / 1e6
    return TrialOutcome(
        campaign=row.campaign,
        experiment=row.experiment,
        trial=row.trial,
        outcome=_verdict(found, "incipient", "detected_first"),
        gross=_verdict(found, "gross", "detected"),
        duration_ms=length,
        **{name: getattr(found, name, None) for name in times},
    )


def _verdict(found: TrialLatency | None, kind: str, counted: str) -> Any:
    """Return the outcome of one of a trial's detections."""
    if found is None:
        return "without_onsets"
    if getattr(found, f"missed_{kind}"):
        return "missed"
    if getattr(found, f"false_early_{kind}"):
        return "false_early"
    return counted if getattr(found, f"late_{kind}_ms") is None else "late"


def account(
    campaigns: Sequence[Collected], trials: Iterable[TrialOutcome], experiment: str
) -> Accounts:
    """Count every trial to be scored by an experiment's plans, by its outcome."""
    judged = {(row.campaign, row.trial): row.outcome for row in trials}
    counts: Counter[str] = Counter()
    for item in campaigns:
        if item.experiment == experiment:
            there = {trial.id for trial, _ in item.trials}
            for trial in item.planned:
                if trial.split == "test":
                    other = "not_evaluated" if trial.id in there else "not_taken"
                    counts[judged.get((item.name, trial.id), other)] += 1
    return Accounts(planned=counts.total(), **{name: counts[name] for name in OUTCOMES})


def trial_intervals(trials: Sequence[TrialOutcome], rules: Iterable[Rule] = ()) -> TrialIntervals:
    """Return the interval of each time's mean, median and 95th percentile over trials.

    In medians missed and late detections count, see `LatencyFigures`.

    Args:
        rules: as of `least_ms`.
    """
    rules, found = list(rules), {}
    for name in TIMES:
        there = times(trials, name)
        least = least_ms(name, rules)
        spans: dict[str, Span] = {kind: interval(there, kind, least) for kind in ("mean", "p95")}
        lost = [value for row in trials if (value := lost_ms(vars(row), name)) is not None]
        spans["median"] = median_span(there, len(lost), min(lost, default=math.inf), least)
        found[name] = TimeIntervals(n=len(there), **spans)
    return TrialIntervals(**found)


def least_ms(name: str, rules: Iterable[Rule]) -> float:
    """Return the least that one of `TIMES` can be, ms; no interval of it reaches below.

    Leads and lengths are not negative, and latencies not earlier than the tolerance.

    Args:
        rules: of detection, with the tolerance of early detections.
    """
    if name in ("duration_ms", "lead_ms"):
        return 0.0
    early_ms = [rule.false_early_ms for rule in rules if rule.false_early_ms is not None]
    return -max(early_ms, default=math.inf)


def lost_ms(trial: Mapping[str, Any], name: str) -> float | None:
    """Return a lost detection's time in a median: infinitely late, or no lead; None of another.

    Args:
        trial: a `TrialOutcome` as a mapping.
        name: of `TIMES`.
    """
    if trial.get(CAUSE.get(name, "")) not in ("missed", "late"):
        return None
    return -math.inf if name == "lead_ms" else math.inf


def times(trials: Iterable[TrialOutcome], name: str) -> list[float]:
    """Return one of `TIMES` of every trial that has it."""
    return [value for row in trials if (value := getattr(row, name)) is not None]


class Conditions:
    """Evaluated trials of one experiment by condition, in the order of the factors' levels.

    Args:
        rows: of the evaluation.
    """

    def __init__(
        self, campaigns: Sequence[Collected], rows: Sequence[TrialScore], experiment: str
    ) -> None:
        self.factors: dict[str, list[str]] = {}
        names = {item.name for item in campaigns if item.experiment == experiment}
        for item in campaigns:
            for name, levels in item.planned.levels.items() if item.name in names else ():
                there = self.factors.setdefault(name, [])
                there += [text for text in levels if text not in there]
        self._rows = [(trial_outcome(row), row.condition) for row in rows if row.campaign in names]

    @property
    def trials(self) -> list[TrialOutcome]:
        """All of them."""
        return [trial for trial, _ in self._rows]

    def varied(self) -> list[str]:
        """Return the factors with several levels, or all if none has."""
        several = [name for name, levels in self.factors.items() if len(levels) > 1]
        return several or list(self.factors)

    def at(self, **levels: str) -> list[TrialOutcome]:
        """Return the trials with these levels."""
        return [
            trial
            for trial, condition in self._rows
            if all(condition.get(name) == text for name, text in levels.items())
        ]

    def cells(self, factors: Sequence[str]) -> dict[str, list[TrialOutcome]]:
        """Return the trials by all pairs (or singles) of levels, named ``0.165 kg, 0.3 mm/s``."""
        return {
            ", ".join(levels): self.at(**dict(zip(factors, levels, strict=True)))
            for levels in itertools.product(*(self.factors[name] for name in factors))
        }

    def breaks(self, factors: Sequence[str]) -> list[int]:
        """Return the rows of `cells` at which the first factor's level changes."""
        step = math.prod(len(self.factors[name]) for name in factors[1:])
        if step < 2:
            return []
        return [step * k for k in range(1, len(self.factors[factors[0]]))]


MOST_FAILURES = 60
"""Rows of the table of failures; `summary.json` has all trials."""
_FAILED = ("missed", "false_early", "late", "without_onsets")
"""Outcomes of an incipient detection that are failures, the worst first."""


@dataclass(frozen=True)
class FailureSection(Content):
    """Trials that were missed, late, false early or cannot be evaluated.

    Attributes:
        causes: what went wrong, and in how many trials.
        store: the store's folder, as a shell takes it.
    """

    template: ClassVar[str] = "failures.html"
    failed: int
    judged: int
    causes: Sequence[tuple[str, int]]
    most: int
    table: Table
    store: str

    @property
    def notices(self) -> list[str]:
        """How many trials failed, and how."""
        if not self.failed:
            return []
        causes = "; ".join(f"{count} {text}" for text, count in self.causes)
        return [f"{self.failed} of {self.judged} evaluated trials failed: {causes}"]


def failure_section(folder: Path, trials: Sequence[TrialOutcome]) -> FailureSection:
    """List the failures of a store, each with the command that shows it."""
    failed = sorted((row for row in trials if _wrong(row)), key=_rank)
    known = Counter(row.trial for row in trials)
    store = shlex.quote(str(folder.resolve()))
    rows = []
    for row in failed[:MOST_FAILURES]:
        command = f"sliplab view {store} {shlex.quote(row.trial)}"
        if known[row.trial] > 1:
            command += f" --campaign {shlex.quote(row.campaign)}"
        latencies = (row.latency_incipient_ms, row.latency_gross_ms, row.lead_ms)
        wrong = f"{row.campaign}: {', '.join(_wrong(row))}"
        if row.late_gross_ms is not None:
            wrong += f", {row.late_gross_ms:.0f} ms after it ended"
        rows.append([command, wrong, *(number(value, 0) for value in latencies)])
    columns = (
        "look at the trial",
        "what went wrong",
        "incipient latency (ms)",
        "gross latency (ms)",
        "lead (ms)",
    )
    counts = Counter(text for row in trials for text in _wrong(row))
    return FailureSection(
        len(failed),
        len(trials),
        counts.most_common(),
        MOST_FAILURES,
        Table(columns, rows, commands=(0,)),
        store,
    )


def _wrong(row: TrialOutcome) -> list[str]:
    """Return the causes for which a trial failed, as text that trials share."""
    if row.outcome == "without_onsets":
        return ["no onset in the label, cannot be judged"]
    found = [f"incipient {WORDS[row.outcome]}"] if row.outcome in _FAILED else []
    if row.gross == "late":
        found.append("gross late")
    elif row.gross in _FAILED:
        found.append(f"gross {WORDS[row.gross]}")
    return found


def _rank(row: TrialOutcome) -> int:
    return _FAILED.index(row.outcome) if row.outcome in _FAILED else len(_FAILED)
