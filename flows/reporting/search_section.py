"""The report's words on the detector's search: the front, and the paper's settings beside it.

Read of `sliplab tradeoff --detector`'s numbers, each an entry of ``rows``: the settings named in
`SETTINGS`; ``front`` and ``paper``, true or false; under ``test`` and ``work`` a list for each
figure of `FIGURES`, one value a seed. More may stand there.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sliplab.analysis.report.figures.tradeoffs import Panel, Point, cost_and_error
from sliplab.analysis.report.page import Figure, Table, number

Json = dict[str, Any]

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
MOST = 25
"""Rows of the front that are listed."""


def search(found: Json, simulated: bool) -> tuple[Figure, Table]:
    """Figure and table of a search.

    Raises:
        KeyError, TypeError: it is of another shape.
    """
    rows = list(found["rows"])
    cost = ("work", "us_per_s")
    panels = [
        Panel(cost[1], key[1], FIGURES[cost][0], f"{FIGURES[key][0]}, test trials")
        for key in (("test", "mean_ms"), ("test", "strict"))
    ]
    data: dict[str, Sequence[object]] = {
        heading: [row[name] for row in rows] for name, heading in SETTINGS.items()
    }
    for key, (heading, factor, _) in FIGURES.items():
        data[heading] = [None if (v := _mean(row, key)) is None else factor * v for row in rows]
    data["on the front"] = [row["front"] for row in rows]
    figure = Figure(
        cost_and_error([_point(row) for row in rows], panels, simulated=simulated),
        "Each dot is a network with a rule: how much it computes for a second of events, against "
        "its mean latency and its accuracy (means over seeds). Blue: no other is better in every "
        "figure. The star has the paper's settings.",
        "tradeoff-detector",
        data,
    )
    shown = [row for row in rows if row["paper"]] + sorted(
        (row for row in rows if row["front"] and not row["paper"]),
        key=lambda row: _mean(row, ("test", "mean_ms")) or float("inf"),
    )
    table = [
        [
            "paper's" if row["paper"] else "front",
            _words(row),
            *(_cell(row, key) for key in FIGURES),
        ]
        for row in shown[:MOST]
    ]
    columns = ("", "detector", *(heading for heading, _, _ in FIGURES.values()))
    note = f" The first {MOST} of {len(shown)}, by latency." if len(shown) > MOST else ""
    return figure, Table(columns, table, f"The front of {len(rows)} detectors, test trials.{note}")


def _mean(row: Json, key: tuple[str, str]) -> float | None:
    values = row[key[0]].get(key[1]) or []
    if not values or any(value is None for value in values):
        return None
    return float(np.mean(values))


def _point(row: Json) -> Point:
    values = {
        key[1]: None if (value := _mean(row, key)) is None else factor * value
        for key, (_, factor, _) in FIGURES.items()
    }
    return Point(values, bool(row["front"]), bool(row["paper"]))


def _cell(row: Json, key: tuple[str, str]) -> str:
    value = _mean(row, key)
    _, factor, digits = FIGURES[key]
    return number(None if value is None else factor * value, digits)


def _words(row: Json) -> str:
    """A row's settings in words."""
    return (
        f"{row['length_ms']} ms in steps of {row['step_ms']} ms, cells of {row['pool_px']} px, "
        f"width ×{row['width']:g}, {row['precision']}; every {row['stride_ms']} ms, "
        f"{row['smoothing']} windows, margin {row['margin']:g}"
    )
