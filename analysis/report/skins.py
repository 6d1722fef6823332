"""Skins in the report: which trials were taken with which, and how their figures differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Content, Table, number
from sliplab.protocols.split import PARTS
from sliplab.storage.schema.evaluation import TrialScore
from sliplab.storage.trials.context import SKIN


@dataclass
class _SkinTrials:
    """The trials of one skin of a campaign; rates in 1/s, times in ms."""

    parts: dict[str, int] = field(default_factory=lambda: dict.fromkeys(PARTS, 0))
    trials: int = 0
    event_rates: list[float] = field(default_factory=list)
    slips: list[float] = field(default_factory=list)
    latencies: list[float] = field(default_factory=list)
    leads: list[float] = field(default_factory=list)


@dataclass(frozen=True)
class SkinSection(Content):
    """Trials and figures by skin.

    Attributes:
        skins: their serial numbers.
        mixed: those with training and test trials; unseen: those with test trials alone.
    """

    template: ClassVar[str] = "skins.html"
    skins: Sequence[str]
    mixed: Sequence[str]
    unseen: Sequence[str]
    table: Table


def skin_section(
    campaigns: Sequence[Collected], rows: Sequence[TrialScore] = ()
) -> SkinSection | None:
    """Compare the skins; None where all trials were taken with one.

    Args:
        rows: of the evaluation.
    """
    scores = {(row.campaign, row.trial): row for row in rows}
    found: dict[tuple[str, str], _SkinTrials] = {}
    for item in campaigns:
        if item.recorded is None:
            _add(found, item, scores)
    skins = list(dict.fromkeys(skin for _, skin in found))
    if len(skins) < 2:
        return None

    def having(part: str) -> set[str]:
        return {skin for (_, skin), of in found.items() if of.parts[part]}

    seen, tested = having("train") | having("validation"), having("test")
    lines = [
        [
            skin,
            name,
            *(str(count) for count in (of.trials, *of.parts.values())),
            _middle(of.event_rates, 0),
            *(_middle(values, 1) for values in (of.slips, of.latencies, of.leads)),
        ]
        for (name, skin), of in found.items()
    ]
    columns = (
        "skin",
        "campaign",
        "trials",
        *PARTS,
        "events (1/s)",
        "motion to first slip (ms)",
        "latency, incipient (ms)",
        "lead (ms)",
    )
    return SkinSection(
        skins,
        [skin for skin in skins if skin in seen & tested],
        [skin for skin in skins if skin in tested - seen],
        Table(columns, lines, "Medians by skin; times are those of test trials."),
    )


def _add(
    found: dict[tuple[str, str], _SkinTrials],
    item: Collected,
    scores: Mapping[tuple[str, str], TrialScore],
) -> None:
    for trial, recording in item.trials:
        skin = recording.context.get(SKIN, "not known")
        of = found.setdefault((item.name, skin), _SkinTrials())
        of.trials += 1
        if trial.split in of.parts:
            of.parts[trial.split] += 1
        record, score = recording.record, scores.get((item.name, trial.id))
        of.event_rates.append(record.counts.events / record.recorded_s)
        if score is None:
            continue
        if score.incipient_ns is not None:
            of.slips.append((score.incipient_ns - recording.motion_ns[0]) / 1e6)
        if score.latency is not None:
            times = (score.latency.latency_incipient_ms, score.latency.lead_ms)
            for values, time in zip((of.latencies, of.leads), times, strict=True):
                values += [] if time is None else [time]


def _middle(values: Sequence[float], digits: int) -> str:
    return number(median(values) if values else None, digits)
