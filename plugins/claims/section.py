"""Claims of each campaign in the report: every look, and how the campaign ended."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Content, Figure, Table
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection
from sliplab.plugins.claims import plot as figures
from sliplab.plugins.claims.document import Look, StoppingRecord
from sliplab.plugins.claims.shown import verdict_text
from sliplab.protocols.hashing import hash_data
from sliplab.storage.schema.campaign_end import CHOICES, Verdict
from sliplab.storage.trials.store import TrialStore

ENDED: dict[Verdict, str] = {
    "open": "It has not ended: the next collection continues.",
    "settled": "It ended because every claim is settled.",
    "most": "It ended because another round would exceed the protocol's most trials.",
    "all": "It ended with all its trials taken.",
    "overruled": "Its claims were settled; a person went on with --no-stopping.",
}
COLUMNS = (
    "claim",
    "verdict",
    "after (trials)",
    "estimate",
    "low",
    "high",
    "unit",
    "figures",
    "undetected",
    "missing",
    "blocks",
    "variance between blocks (%)",
)


@dataclass(frozen=True)
class Claimed:
    """A campaign with claims.

    Attributes:
        error: chance at most of calling a claim that is false, percent.
        target: what claims are about. chosen: its trials were chosen by what they tell.
    """

    name: str
    error: float
    taken: int
    planned: int
    ended: str
    target: str
    chosen: bool
    table: Table
    figure: Figure


@dataclass(frozen=True)
class ClaimsSection(Content):
    """Every campaign with claims."""

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    campaigns: Sequence[Claimed]

    def all_figures(self) -> list[Figure]:
        """Return the figures of all campaigns."""
        return [each.figure for each in self.campaigns]


def claims_key(store: TrialStore, campaigns: Sequence[Collected]) -> list[str]:
    """Return the further inputs of a report with claims; empty without any."""
    found = [StoppingRecord.of(item.campaign.folder) for item in campaigns]
    return [hash_data(each.to_json()) for each in found if each is not None]


def claims_section(data: ReportData) -> ClaimsSection | None:
    """Show the claims of each campaign that has looked at some; None where none has."""
    found = []
    for item in data.campaigns:
        record = StoppingRecord.of(item.campaign.folder)
        stopping = None if item.recorded is not None else item.plan.protocol.collection.stopping
        if record is None or stopping is None or not record.looks:
            continue
        found.append(
            Claimed(
                item.name,
                100.0 * stopping.error,
                record.looks[-1].taken,
                sum(trial.role == "measured" for trial in item.plan),
                ENDED[record.verdict],
                record.target,
                (item.campaign.folder / CHOICES).exists(),
                Table(COLUMNS, [_row(record.looks, k) for k in range(len(stopping.claims))]),
                _figure(item.name, record.looks, data.simulated),
            )
        )
    return ClaimsSection(found) if found else None


def _row(looks: Sequence[Look], k: int) -> list[str]:
    """Return a claim's last state, with the look that called it."""
    last = looks[-1].claims[k]
    called = [look.taken for look in looks if look.claims[k].holds or look.claims[k].refuted]
    numbers = ["–" if v is None else f"{v:.4g}" for v in (last.estimate, last.low, last.high)]
    return [
        last.claim,
        verdict_text(last),
        str(called[0]) if called else "–",
        *numbers,
        last.unit,
        str(last.trials),
        str(last.undetected),
        str(last.missing),
        str(last.blocks),
        "–" if last.block_share is None else f"{100.0 * last.block_share:.0f}",
    ]


def _figure(name: str, looks: Sequence[Look], simulated: bool) -> Figure:
    claims = range(len(looks[0].claims))
    data: dict[str, Sequence[object]] = {"trials": [look.taken for look in looks]}
    for k in claims:
        states = [look.claims[k] for look in looks]
        title = f"{k + 1}: {states[0].claim}"
        for end in ("estimate", "low", "high"):
            data[f"{title}, {end} ({states[0].unit})"] = [getattr(each, end) for each in states]
    return Figure(figures.looks(looks, simulated=simulated), name=f"claims-{name}", data=data)


SECTION = ReportSection(claims_section, claims_key)
"""Claims in the report."""
