"""`sliplab calibrate gap`: networks trained on simulated trials, tested on real ones."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, StoreArgument
from sliplab.plugins.twin.document import TITLES, GapNetwork, TwinGap
from sliplab.plugins.twin.options import campaigns_of
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

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


def measure(
    folder: StoreArgument,
    rig: Annotated[Path, typer.Option("--rig", help="The twin's rig file (YAML).")],
    protocol: Annotated[
        Path, typer.Option("--protocol", help="Protocol whose training trials are simulated.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the page and of simulated trials.")],
    campaign: CampaignOption = None,
    worlds: Annotated[
        int, typer.Option("--worlds", min=1, max=1000, help="Rigs drawn from the twin's posterior.")
    ] = 8,
) -> Finding[TwinGap]:
    """Train networks on a twin, and test them on the labelled test trials of its real rig."""
    store, campaigns = campaigns_of(folder, campaign)
    from sliplab.plugins.twin.gap.flow import measure_gap, request

    found = measure_gap(request(store, campaigns, rig, protocol, out, worlds))
    return Finding(found, out, named={"folder": out})


def shown(found: TwinGap) -> Iterator[Table]:
    """Yield the table of networks."""
    from sliplab.analysis.report.page import Table

    trials = plural(found.trials, ("simulated " if found.simulated else "") + "test trial")
    rows = [_cells(it) for it in found.networks]
    yield Table(COLUMNS, rows, f"gap of the twin {found.rig}, {trials}", spare=4)


def view(found: TwinGap) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.figures.intervals import ShareInterval, shares
    from sliplab.analysis.report.page import Figure, Table

    strict = [(it.title, it.windows.strict) for it in found.networks]
    rows = {
        "network trained on": [ShareInterval(title, s.share, s.low, s.high) for title, s in strict]
    }
    label = "strict accuracy on the test trials (%)"
    table = [_cells(it) for it in found.networks]
    return {
        "campaigns": " and ".join(found.campaigns),
        "accuracy": Figure(shares(rows, label, simulated=found.simulated)),
        "networks": Table(COLUMNS[:LATENCIES], [row[:LATENCIES] for row in table]),
        "latencies": Table(
            ("trained on", *COLUMNS[LATENCIES:]), [[row[0], *row[LATENCIES:]] for row in table]
        ),
        "first": TITLES[found.networks[0].trained_on],
    }


def _cells(it: GapNetwork) -> list[str]:
    """Return a network as cells below `COLUMNS`; medians of latencies and leads."""
    from sliplab.analysis.report.page import number

    strict, slides = it.windows.strict, it.experiments["kinematic"].latency_ms
    less = it.behind
    return [
        it.title,
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


def _points(share: float | None) -> str:
    from sliplab.analysis.report.page import percent

    return percent(share).removesuffix(" %")


def _span(low: float | None, high: float | None) -> str:
    return "–" if low is None or high is None else f"{_points(low)} to {_points(high)}"


STUDY = Study(
    name="gap",
    title="Networks of a twin, tested on the rig that it imitates, by SlipLab",
    measure=measure,
    result=TwinGap,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab calibrate gap my-store --rig twin.yaml --protocol kinematic --out gap",
)
