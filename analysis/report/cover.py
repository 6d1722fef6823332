"""The first screen of a report: the question, the figure that answers it, and what failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sliplab.analysis.report.latency import EXPERIMENTS, draw_times
from sliplab.analysis.report.outcomes import TIMES
from sliplab.analysis.report.page import (
    Figure,
    Number,
    with_interval,
)
from sliplab.protocols.shown import plural
from sliplab.storage.schema.summary import (
    Experiment,
    OneCameraSummary,
    QualitySummary,
    Summary,
    TrialOutcome,
)


@dataclass(frozen=True)
class Answer:
    """A figure that answers the question, with its caption, and the same in sentences."""

    sentences: Sequence[str]
    figure: Figure | None
    caption: str = ""


@dataclass(frozen=True)
class Cover:
    """The first screen.

    Attributes:
        template: of the page.
        notices: what failed or is missing, besides those of the sections.
        headline: numbers below it.
    """

    template: str | Path
    answer: Answer
    notices: Sequence[str]
    headline: Sequence[Number]


def slip_answer(summary: Summary | OneCameraSummary) -> Answer:
    """Return how soon, and in how many trials, incipient slip was detected."""
    groups: dict[str, list[TrialOutcome]] = {}
    sentences = []
    for name, title in EXPERIMENTS.items():
        found: Experiment | None = getattr(summary, name)
        if found is None or not found.accounted.planned:
            continue
        accounts = found.accounted
        lacking = accounts.not_taken + accounts.not_evaluated
        planned = plural(accounts.planned, "test trial")
        if lacking == accounts.planned:
            sentences.append(f"{title}: {planned} planned, none taken and evaluated.")
            continue
        trials = [row for row in summary.trials if row.experiment == name]
        groups[f"{name}, n = {len(trials)}"] = trials
        latency, spans = found.latency_ms.incipient, found.intervals
        late = with_interval(latency.median, spans.latency_incipient_ms.median, 0, "ms")
        lead = with_interval(found.lead_ms.median, spans.lead_ms.median, 0, "ms")
        sentences.append(
            f"{title}: {accounts.detected_first} of {planned} detected before gross slip"
            f"{f' ({lacking} not taken or evaluated)' if lacking else ''}. "
            f"Medians (95 % intervals): {late} after the onset, {lead} before gross slip."
        )
    if not groups:
        return Answer(sentences or ["There is no test trial: nothing was tested."], None)
    shown, rules = (TIMES[1], TIMES[3]), list(summary.detection.values())
    return Answer(
        sentences,
        draw_times(groups, shown, (), "answer", rules, summary.simulated),
        "Time from the labelled onset of incipient slip to its detection (left), and from there to "
        "gross slip (right). A dot is a trial, the diamond the mean, the bar its 95 % interval (an "
        "arrow: cut off); at the right end trials without a value, and why.",
    )


def quality_notices(quality: QualitySummary) -> list[str]:
    """Return trials that are missing or in quarantine, as text."""
    counts = {
        f"of {quality.planned} planned trials not committed": quality.planned - quality.committed,
        "failed attempts in quarantine": quality.quarantined,
        "attempts interrupted": quality.interrupted,
    }
    return [f"{count} {text}" for text, count in counts.items() if count]
