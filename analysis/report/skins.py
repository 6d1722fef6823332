"""Skins in the report: which trials were taken with which, and how their figures differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import pandas as pd

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Content, Table, number
from sliplab.protocols.split import PARTS
from sliplab.storage.schema.evaluation import TrialScore
from sliplab.storage.trials.context import SKIN
from sliplab.storage.trials.recording import Recording

_FIGURES = {
    "events (1/s)": 0,
    "motion to first slip (ms)": 1,
    "latency, incipient (ms)": 1,
    "lead (ms)": 1,
}
"""Figures whose medians are shown, and their digits."""


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
    trials = pd.DataFrame(
        [
            {
                "skin": recording.context.get(SKIN, "not known"),
                "campaign": item.name,
                "part": trial.split,
                **_figures(recording, scores.get((item.name, trial.id))),
            }
            for item in campaigns
            if item.recorded is None
            for trial, recording in item.trials
        ],
        columns=["skin", "campaign", "part", *_FIGURES],
    )
    skins = trials["skin"].unique().tolist()
    if len(skins) < 2:
        return None
    seen, tested = (
        set(trials["skin"][trials["part"].isin(parts)])
        for parts in (("train", "validation"), ("test",))
    )
    lines = []
    for (skin, campaign), there in trials.groupby(["skin", "campaign"], sort=False):
        counts = [len(there), *((there["part"] == part).sum() for part in PARTS)]
        middle = there[[*_FIGURES]].astype(float).median()
        figures = [number(float(middle[name]), digits) for name, digits in _FIGURES.items()]
        lines.append([skin, campaign, *map(str, counts), *figures])
    return SkinSection(
        skins,
        [skin for skin in skins if skin in seen & tested],
        [skin for skin in skins if skin in tested - seen],
        Table(
            ("skin", "campaign", "trials", *PARTS, *_FIGURES),
            lines,
            "Medians by skin; times are those of test trials.",
        ),
    )


def _figures(recording: Recording, score: TrialScore | None) -> dict[str, float | None]:
    """Return the figures of a trial by the headings of `_FIGURES`."""
    slip_ms = late_ms = lead_ms = None
    if score is not None and score.incipient_ns is not None:
        slip_ms = (score.incipient_ns - recording.motion_ns[0]) / 1e6
    if score is not None and score.latency is not None:
        late_ms, lead_ms = score.latency.latency_incipient_ms, score.latency.lead_ms
    rate = recording.record.counts.events / recording.record.recorded_s
    return dict(zip(_FIGURES, (rate, slip_ms, late_ms, lead_ms), strict=True))
