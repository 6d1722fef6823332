"""The page of a twin's gap: networks trained on simulated trials, tested on real ones."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.report.figures.intervals import Share, shares
from sliplab.analysis.report.page import Figure, Table, number, percent, render_page
from sliplab.plugins.twin.document import GapNetwork, TwinGap

TITLES = {
    "own": "the tested rig's own trials",
    "twin": "the twin",
    "drawn": "rigs drawn from the twin's posterior",
    "assumed": "the rig file as it was",
}
COLUMNS = (
    "trained on",
    "trials",
    "validation (%)",
    "accuracy (%)",
    "95 %",
    "behind (points)",
    "95 %",
    "F1 (%)",
    "slides: incipient, gross (ms)",
    "gravity: lead (ms)",
    "disturbance: lead (ms)",
)
LATENCIES = 8
"""First column of the second table, of latencies; one table would be too wide for a page."""


def render(found: TwinGap) -> str:
    """Return the page as text."""
    rows = [
        Share(_title(it), it.windows.strict.share, it.windows.strict.low, it.windows.strict.high)
        for it in found.networks
    ]
    svg = shares(
        {"network trained on": rows},
        "strict accuracy on the test trials (%)",
        simulated=found.simulated,
    )
    table = [cells(it) for it in found.networks]
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=found.simulated,
        found=found,
        campaigns=" and ".join(found.campaigns),
        accuracy=Figure(svg),
        networks=Table(COLUMNS[:LATENCIES], [row[:LATENCIES] for row in table]),
        latencies=Table(
            ("trained on", *COLUMNS[LATENCIES:]), [[row[0], *row[LATENCIES:]] for row in table]
        ),
        first=TITLES[found.networks[0].trained_on],
    )


def cells(it: GapNetwork) -> list[str]:
    """Return a network as cells of a table, see `COLUMNS`; medians of latencies and leads."""
    strict, slides = it.windows.strict, it.experiments["kinematic"].latency_ms
    less = it.behind
    return [
        _title(it),
        str(it.trials),
        _points(it.validation),
        _points(strict.share),
        _span(strict.low, strict.high),
        "–" if less is None else _points(less.share),
        "–" if less is None else _span(less.low, less.high),
        _points(it.f1),
        f"{number(slides.incipient.median, 0)}, {number(slides.gross.median, 0)}",
        *(number(it.experiments[name].lead_ms.median, 0) for name in ("gravity", "disturbance")),
    ]


def _title(it: GapNetwork) -> str:
    title = TITLES[it.trained_on]
    if it.rigs > 1:
        title = f"{it.rigs} {title}"
    return f"{title} (simulated)" if it.simulated else title


def _points(share: float | None) -> str:
    return percent(share).removesuffix(" %")


def _span(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{_points(low)} to {_points(high)}"
