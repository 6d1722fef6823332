"""Speed of a detector against its error, in the report."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sliplab.analysis.report.page import Content, Figure, Table, number
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection
from sliplab.analysis.report.programs import CommandResult
from sliplab.plugins.studies.detector.document import DetectorRow, DetectorTradeoff, mean
from sliplab.plugins.studies.plot import AxisPair, DetectorPoint, cost_and_error
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import TrialStore

RESULT = CommandResult("report/detector_tradeoff.json", "sliplab tradeoff {store}")


@dataclass(frozen=True)
class TradeoffSection(Content):
    """Speed against error of detectors, or how to measure it.

    Attributes:
        command: that measures it. link: of its page.
        most: rows of the front that are listed, of `front`. tried: number of detectors.
    """

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    command: str
    search: Figure | None = None
    found: Table | None = None
    most: int = 0
    front: int = 0
    tried: int = 0
    link: str = ""

    @property
    def unmeasured(self) -> bool:
        """True where it was not measured."""
        return self.search is None


def tradeoff_section(store: TrialStore, found: Json | None) -> TradeoffSection:
    """Show the search of detectors; None: there was none.

    Raises:
        StoreError: it is of another shape.
    """
    command = RESULT.command(store)
    if found is None:
        return TradeoffSection(command)
    result = RESULT.parse(DetectorTradeoff, found)
    search = _draw_search(result.rows, simulated=result.simulated)
    table, front = _search_table(result.rows)
    page = (store.folder / RESULT.file).with_suffix(".html")
    link = os.path.relpath(page, store.folder / "report").replace(os.sep, "/")
    link = link if page.exists() else ""
    return TradeoffSection(command, search, table, MOST, front, len(result.rows), link)


SETTINGS = {
    "length_ms": "window (ms)",
    "step_ms": "step (ms)",
    "pool_px": "cell (px)",
    "width": "width",
    "precision": "precision",
    "stride_ms": "stride (ms)",
    "smoothing": "smoothing (windows)",
    "margin": "margin (spikes)",
}
FIGURES = {
    ("test", "strict"): ("strict accuracy (%)", 100.0, 1),
    ("test", "mean_ms"): ("mean latency (ms)", 1.0, 0),
    ("test", "p95_ms"): ("95th percentile (ms)", 1.0, 0),
    ("test", "false_early_either"): ("false early (%)", 100.0, 1),
    ("test", "lost_either"): ("missed or late (%)", 100.0, 1),
    ("work", "us_per_s"): ("work (µs/s)", 1.0, 0),
    ("work", "synaptic_operations_per_s"): ("synaptic operations (million/s)", 1e-6, 2),
}
"""Figures of each row of the detector's search, lists over seeds: heading, factor, digits."""
MOST = 25
"""Rows of the front that are listed."""


def _scaled(row: DetectorRow, key: tuple[str, str]) -> float | None:
    """Return the mean over seeds; None where one is missing."""
    found = mean(getattr(row, key[0]).get(key[1], ()))
    return None if found is None else FIGURES[key][1] * found


def _draw_search(rows: Sequence[DetectorRow], *, simulated: bool) -> Figure:
    cost = ("work", "us_per_s")
    panels = [
        AxisPair(cost[1], key[1], FIGURES[cost][0], f"{FIGURES[key][0]}, test trials")
        for key in (("test", "mean_ms"), ("test", "strict"))
    ]
    points = [
        DetectorPoint({key[1]: _scaled(row, key) for key in FIGURES}, row.front, row.paper)
        for row in rows
    ]
    data: dict[str, Sequence[object]] = {
        **{heading: [getattr(row, name) for row in rows] for name, heading in SETTINGS.items()},
        **{FIGURES[key][0]: [_scaled(row, key) for row in rows] for key in FIGURES},
        "on the front": [row.front for row in rows],
    }
    svg = cost_and_error(points, panels, simulated=simulated)
    return Figure(svg, name="tradeoff-detector", data=data)


def _search_table(rows: Sequence[DetectorRow]) -> tuple[Table, int]:
    """List the paper's settings and the front, by latency; and count them."""
    shown = [row for row in rows if row.paper] + sorted(
        (row for row in rows if row.front and not row.paper),
        key=lambda row: _scaled(row, ("test", "mean_ms")) or float("inf"),
    )
    words = (
        "{length_ms} ms in steps of {step_ms} ms, cells of {pool_px} px, width ×{width:g}, "
        "{precision}; every {stride_ms} ms, {smoothing} windows, margin {margin:g}"
    )
    cells = [
        [
            "paper's" if row.paper else "front",
            words.format(**row.to_json()),
            *(number(_scaled(row, key), digits) for key, (_, _, digits) in FIGURES.items()),
        ]
        for row in shown[:MOST]
    ]
    columns = ("", "detector", *(heading for heading, _, _ in FIGURES.values()))
    return Table(columns, cells), len(shown)


def _make(data: ReportData) -> TradeoffSection | None:
    if data.collected is None:
        return None
    return tradeoff_section(data.store, RESULT.read(data.store))


SECTION = ReportSection(_make, RESULT.key, last=True)
"""Trade-offs in the report."""
