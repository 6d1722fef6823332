"""Table of the report's figures and those of the paper.

Lu, Deng, Redmond, Psomopoulou and Ward-Cherrier, "A Neuromorphic Incipient Slip Detection System
using Papillae Morphology". Measured on a real robot with a real skin: nothing here says that a
simulated figure near a published one is right, or that one far from it is wrong.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.report.alarms import DISTURBED, QUIET, rate_words
from sliplab.analysis.report.figures.style import CLASS_WORDS
from sliplab.analysis.report.page import Content, Table, number, percent
from sliplab.analysis.report.seeds import seed_words
from sliplab.protocols.shown import plural
from sliplab.storage.schema.evaluation import AlarmRate, Share
from sliplab.storage.schema.summary import (
    Experiment,
    NetworkSummary,
    NetworkWindows,
    PaperSettings,
    Span,
    Summary,
)

PAPER = {
    "accuracy": "94.33 %",
    "incipient_precision": "97.58 %",
    "incipient_recall": "96.09 %",
    "confused": "no slip and gross slip",
    "incipient_latency": "88 ms",
    "gross_latency": "70 ms",
    "gravity_lead": "at least 360 ms, in every trial",
    "disturbance_lead": "691 ± 118 ms",
}
"""Published figures, by name."""
TRENDS = {
    "gravity, incipient latency": "larger at a low retraction speed and at a small weight",
    "gravity, gross latency": "no clear trend; sometimes early",
    "event rate": "very low at rest, a sharp rise by shear before the first slip, falling as "
    "papillae slip one after another, low in steady gross slip",
}
"""What the paper says without a number, by figure."""
_SCANNED = ["windows scanned", "to past gross slip", "to the recording's end", "published"]
"""A difference that no setting makes."""


@dataclass(frozen=True)
class PaperFigure:
    """One published figure and the same figure of one network."""

    name: str
    paper: str
    value: str
    interval: str = "–"
    count: str = "–"

    @property
    def text(self) -> str:
        """The value with its interval."""
        return self.value if self.interval == "–" else f"{self.value} ({self.interval})"


@dataclass(frozen=True)
class PaperSection(Content):
    """Every published figure with this report's.

    Attributes:
        paper: None where no protocol is the paper's: the networks are compared with each other.
        seeds: that were trained here, with the range of their strict accuracy.
        networks: others on the same trials: title, network and its margins.
    """

    template: ClassVar[str] = "paper.html"
    paper: PaperSettings | None
    networks: Sequence[tuple[str, NetworkSummary, str]]
    rows: Table
    counts: Table
    differences: Table
    seeds: str
    trends: ClassVar[Mapping[str, str]] = TRENDS


def paper_section(summary: Summary) -> PaperSection | None:
    """Compare the networks, and where a protocol names the paper's preset, with the paper.

    Returns:
        None where there is nothing to compare with.
    """
    if summary.paper is None:
        return None
    with_paper = "paper" in {summary.paper.preset, *(of.preset for of in summary.networks.values())}
    if not with_paper and not summary.networks:
        return None
    ending = " (simulated)" if summary.simulated else ""
    networks: dict[str, Summary | NetworkSummary] = {f"here{ending}": summary}
    networks |= {f"{_title(found)}{ending}": found for found in summary.networks.values()}
    each = [
        [*_windows(of.kinematic), *_times(of.kinematic, of.gravity, of.disturbance)]
        for of in networks.values()
    ]
    same = list(zip(*each, strict=True))
    differences = [[it.setting, it.paper, it.here, it.source] for it in summary.paper.differences]
    return PaperSection(
        summary.paper if with_paper else None,
        [
            (
                _title(found),
                found,
                ", ".join(sorted({f"{rule.margin:g}" for rule in found.detection.values()})),
            )
            for found in summary.networks.values()
        ],
        Table(
            ["figure", *(["paper"] if with_paper else []), *networks],
            [
                [of[0].name, *([of[0].paper] if with_paper else []), *(row.text for row in of)]
                for of in same
            ],
        ),
        Table(["figure", *networks], [[of[0].name, *(row.count for row in of)] for of in same]),
        Table(("setting", "paper", "here", "the paper's value is"), [*differences, _SCANNED]),
        seed_words(summary.kinematic.seeds),
    )


def _title(network: NetworkSummary) -> str:
    """Return a column's heading."""
    return f"{network.preset} preset" if network.preset else network.title


def _windows(kinematic: NetworkWindows) -> list[PaperFigure]:
    known = kinematic.window_intervals
    right = kinematic.accuracy
    count = _count(known.get("accuracy"))
    rows = [
        PaperFigure(
            "test accuracy of windows",
            PAPER["accuracy"],
            percent(right.argmax),
            _percents(known.get("accuracy")),
            count,
        ),
        PaperFigure(
            "the same, a tie wrong",
            "–",
            percent(right.strict),
            _percents(kinematic.interval),
            count,
        ),
        PaperFigure("the same, won by the margin", "–", percent(right.margin), count=count),
    ]
    for name, value in (
        ("precision", kinematic.precision["incipient"]),
        ("recall", kinematic.recall["incipient"]),
    ):
        row = known.get(f"incipient_{name}")
        rows.append(
            PaperFigure(
                f"incipient {name}",
                PAPER[f"incipient_{name}"],
                percent(value),
                _percents(row),
                _count(row),
            )
        )
    return [*rows, *_alarms(kinematic.false_alarms), _confused(kinematic.confusion)]


def _alarms(found: dict[str, AlarmRate]) -> list[PaperFigure]:
    """Return false alarms an hour, quiet and under nuisances, which the accuracy costs."""
    names = {QUIET: "false alarms an hour, quiet holding", DISTURBED: "the same, under nuisances"}
    rows = []
    for name, title in names.items():
        rate = found.get(name)
        count = "–" if rate is None else f"{plural(rate.clusters, 'trial')}, {rate.hours:.3f} h"
        rows.append(PaperFigure(title, "–", rate_words(rate), count=count))
    return rows


def _percents(row: Share | None) -> str:
    if row is None or row.low is None:
        return "–"
    return f"{percent(row.low)} to {percent(row.high)}"


def _count(row: Share | None) -> str:
    return "–" if row is None else f"{plural(row.trials, 'trial')} ({plural(row.n, 'window')})"


def _confused(confusion: Sequence[Sequence[int]]) -> PaperFigure:
    """Find the two classes that are most often confused."""
    pairs = {(a, b): confusion[a][b] + confusion[b][a] for a in range(3) for b in range(a + 1, 3)}
    a, b = max(pairs, key=lambda pair: pairs[pair])
    name, paper = "most confused pair", PAPER["confused"]
    if not pairs[a, b]:
        return PaperFigure(name, paper, "none")
    words = f"{CLASS_WORDS[a]} and {CLASS_WORDS[b]}"
    return PaperFigure(name, paper, words, count=plural(pairs[a, b], "window"))


def _times(
    kinematic: Experiment, gravity: Experiment, disturbance: Experiment
) -> list[PaperFigure]:
    rows = []
    for kind, found in (
        ("incipient", kinematic.latency_ms.incipient),
        ("gross", kinematic.latency_ms.gross),
    ):
        rows.append(
            PaperFigure(
                f"kinematic latency, {kind}, mean",
                f"{PAPER[f'{kind}_latency']} after onset",
                number(found.mean, 0, "ms"),
                _ms(kinematic.intervals.of(f"latency_{kind}_ms").mean),
                f"{plural(found.n, 'trial')}; {found.missed} missed, {found.late} late, "
                f"{found.false_early} early",
            )
        )
    first = "{0.detected_first} of {0.planned} trials detected first"
    if gravity.accounted.planned:
        rows.append(
            PaperFigure(
                "gravity lead, smallest",
                PAPER["gravity_lead"],
                number(gravity.lead_ms.min, 0, "ms"),
                count=first.format(gravity.accounted),
            )
        )
    if disturbance.accounted.planned:
        lead = disturbance.lead_ms
        rows.append(
            PaperFigure(
                "disturbance lead, mean ± standard deviation",
                PAPER["disturbance_lead"],
                f"{number(lead.mean, 0)} ± {number(lead.std, 0, 'ms')}",
                _ms(disturbance.intervals.lead_ms.mean),
                first.format(disturbance.accounted),
            )
        )
    return rows


def _ms(span: Span) -> str:
    if span is None or span[0] is None or span[1] is None:
        return "–"
    return f"{span[0]:.0f} to {span[1]:.0f} ms"
