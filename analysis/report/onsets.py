"""The same decisions by several onsets: one table of every network, rule and detector."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.report.detectors import titled
from sliplab.analysis.report.page import Content, Table, number, percent, with_interval
from sliplab.storage.schema.evaluation import OnsetFigures
from sliplab.storage.schema.summary import Summary

WORDS = {
    "paper": "2 pixels (paper)",
    "change_point": "change point",
    "true": "true (simulated)",
}
_COLUMNS = (
    "decided by",
    "onset",
    "trials (lacking)",
    "incipient, median (95 %) (ms)",
    "false early (95 %)",
    "missed, late",
    "early by 2 pixels, not before this",
    "gross, median (ms); false early, missed, late",
)


@dataclass(frozen=True)
class Explained:
    """Detections of all rows that are false early by the 2-pixel onset.

    Attributes:
        onset: the other onset, in words; early: detections, of trials with both onsets.
        not_before: how many of them are at the other onset or after it.
    """

    onset: str
    early: int
    not_before: int


@dataclass(frozen=True)
class OnsetSection(Content):
    """The decisions on kinematic test trials.

    Attributes:
        own: of the store's own network and rule, by onset.
        allowed: validation trials that the detectors' levels allow to be false early; None where
            detectors were not compared, or by a version that stored no figures by onset.
    """

    template: ClassVar[str] = "onsets.html"
    folded: ClassVar[bool] = True
    own: Mapping[str, OnsetFigures]
    explained: Sequence[Explained]
    allowed: int | None
    table: Table


def onset_section(summary: Summary) -> OnsetSection | None:
    """Show each decision by each onset; None where no trial has any."""
    own = summary.kinematic.by_reference
    if not own:
        return None
    entries = {"this store's network and rule": own}
    entries |= {found.title: found.kinematic.by_reference for found in summary.networks.values()}
    allowed = None
    for title, entry in titled(summary.detectors):
        rate = entry.rates[-1]
        if rate.by_reference:
            allowed = rate.allowed
            entries[f"{title}, every {entry.stride_ms} ms"] = rate.by_reference
    rows = [
        [title, *_cells(name, found[name])]
        for title, found in entries.items()
        for name in WORDS
        if name in found
    ]
    explained = [
        Explained(
            WORDS[name],
            sum(found[name].early_by_paper for found in entries.values() if name in found),
            sum(found[name].not_before for found in entries.values() if name in found),
        )
        for name in WORDS
        if name in own and name != "paper"
    ]
    return OnsetSection(own, explained, allowed, Table(_COLUMNS, rows))


def _cells(name: str, figures: OnsetFigures) -> list[str]:
    incipient, gross = figures.latency_ms.incipient, figures.latency_ms.gross
    early, rate = str(incipient.false_early), figures.false_early_rate
    if rate is not None:
        early += f" ({100 * rate.low:.0f} to {percent(rate.high, 0)})"
    of_paper = f"{figures.not_before} of {figures.early_by_paper}"
    return [
        WORDS[name],
        f"{figures.trials} ({figures.lacking})",
        with_interval(incipient.median, figures.median_incipient_ms, 0),
        early,
        f"{incipient.missed}, {incipient.late}",
        "–" if name == "paper" else of_paper,
        f"{number(gross.median, 0)}; {gross.false_early}, {gross.missed}, {gross.late}",
    ]
