"""Detectors in the report: each at the same rate of false early detections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import pandas as pd

from sliplab.analysis.report.figures.detectors import latency_over_rate
from sliplab.analysis.report.page import Content, Figure, Table, number, percent
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import (
    DetectorComparison,
    DetectorRate,
    DetectorScores,
    LatencyFigures,
    PartTrials,
)

WORDS = {
    "smoothing": "paper's rule",
    "smoothing chosen": "paper's rule, window chosen",
    "hmm histograms": "hidden Markov, histograms",
    "hmm counts": "hidden Markov, counts",
    "hmm counts and events": "hidden Markov, counts and events",
    "cusum histograms": "CUSUM, histograms",
    "cusum counts": "CUSUM, counts",
    "cusum counts and events": "CUSUM, counts and events",
}
PAPER = ("smoothing", "smoothing chosen")
_COLUMNS = (
    "detector",
    "stride (ms)",
    "false early in validation",
    "false early in test (95 %)",
    "incipient, median / 95 % (ms)",
    "missed, late",
    "gross, median (ms); missed, late",
    "lead, median (ms)",
)


@dataclass(frozen=True)
class Best:
    """The detector that validation trials find quickest, at the last rate; `rule`: the paper's."""

    title: str
    stride_ms: int
    rate: DetectorRate
    rule: DetectorRate


@dataclass(frozen=True)
class DetectorSection(Content):
    """The comparison.

    Attributes:
        trials: by split.
        smoothing: windows that the paper's rule averages.
        first_slip_ms: as of an `Experiment`, kinematic.
    """

    template: ClassVar[str] = "detectors.html"
    folded: ClassVar[bool] = True
    trials: PartTrials
    smoothing: int
    best: Best | None
    first_slip_ms: float | None
    figure: Figure
    tables: Sequence[Table]


def detector_section(
    compared: DetectorComparison | None, first_slip_ms: float | None, *, simulated: bool
) -> DetectorSection | None:
    """Show the comparison; None if there is none.

    Args:
        first_slip_ms: as of an `Experiment`, kinematic.
    """
    if compared is None:
        return None
    entries = titled(compared)
    panels = {}
    for stride in sorted(compared.strides_ms, reverse=True):
        ending = "" if stride < max(compared.strides_ms) else ", no overlap"
        panels[f"every {stride} ms{ending}"] = {
            title: [(point.rate, point.median_ms) for point in entry.curve]
            for title, entry in entries
            if entry.stride_ms == stride
        }
    points = pd.DataFrame(
        [
            (panel, title, rate, late)
            for panel, lines in panels.items()
            for title, curve in lines.items()
            for rate, late in curve
        ],
        columns=[
            "stride",
            "detector",
            "false early, validation trials (share)",
            "median incipient latency, test trials (ms)",
        ],
        dtype=object,
    )
    return DetectorSection(
        compared.trials,
        entries[0][1].rates[0].choice,
        _best(entries),
        first_slip_ms,
        Figure(
            latency_over_rate(panels, first_slip_ms, simulated=simulated),
            name="detectors",
            data={str(name): column for name, column in points.to_dict("list").items()},
        ),
        _tables(entries, compared.trials.validation),
    )


def titled(compared: DetectorComparison | None) -> list[tuple[str, DetectorScores]]:
    """Return every detector of a comparison with its title; none without a comparison."""
    if compared is None:
        return []
    entries = [(WORDS[entry.name], entry) for entry in compared.detectors]
    carried = compared.carried or ()
    return entries + [(f"{WORDS[entry.name]}, states carried", entry) for entry in carried]


def _tables(entries: Sequence[tuple[str, DetectorScores]], trials: int) -> list[Table]:
    """Make one table for each number of trials that may be false early."""
    rates = entries[0][1].rates
    places: dict[int, list[int]] = {}
    for place, rate in enumerate(rates):
        places.setdefault(rate.allowed, []).append(place)
    tables = []
    for allowed, same in places.items():
        asked = " or ".join(percent(rates[place].asked) for place in same)
        bound = f"at most {allowed}" if allowed else "less than one trial, so none"
        caption = f"{asked} of {plural(trials, 'validation trial')} false early: {bound}."
        rows = [
            [title, str(entry.stride_ms), *_cells(entry.rates[same[0]])] for title, entry in entries
        ]
        tables.append(Table(_COLUMNS, rows, caption))
    return tables


def _cells(rate: DetectorRate) -> list[str]:
    incipient, gross = rate.test.latency_ms.incipient, rate.test.latency_ms.gross
    share = rate.test.false_early_rate
    early = f"({100 * share.low:.0f} to {percent(share.high, 0)})"
    return [
        str(rate.validation.latency_ms.incipient.false_early),
        f"{incipient.false_early} {early}",
        f"{number(incipient.median, 0)} / {number(incipient.p95, 0)}",
        _lost(incipient),
        f"{number(gross.median, 0)}; {_lost(gross)}",
        number(rate.test.lead_ms.median, 0),
    ]


def _lost(found: LatencyFigures) -> str:
    return f"{found.missed}, {found.late}"


def _best(entries: Sequence[tuple[str, DetectorScores]]) -> Best | None:
    """Find the one that validation trials find quickest; None where a median is infinite."""
    rule = entries[0][1].rates[-1]
    there = [
        (late, place)
        for place, (_, entry) in enumerate(entries)
        if entry.name not in PAPER
        and (late := entry.rates[-1].validation.median_with_missed_ms) is not None
    ]
    if not there or rule.test.median_with_missed_ms is None:
        return None
    title, best = entries[min(there)[1]]
    rate = best.rates[-1]
    if rate.test.median_with_missed_ms is None:
        return None
    return Best(title, best.stride_ms, rate, rule)
