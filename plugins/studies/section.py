"""Speed against error of scene, labels and detector, in the report."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Content, Figure, Table, number
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection
from sliplab.plugins.studies.plot import Panel, Point, cost_and_error
from sliplab.plugins.studies.results import RESULTS
from sliplab.plugins.studies.scene.page import SceneCost, scene_cost
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store


@dataclass(frozen=True)
class TradeoffSection(Content):
    """Speed against error of scene, labels and detector, as far as they were measured.

    Attributes:
        missing: name of what was not measured, and its command.
        protocol: of the scene, and what its search says; None without one.
    """

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    missing: Sequence[tuple[str, str]]
    protocol: str | None
    scene: SceneCost | None
    scene_figure: Figure | None
    labels: Sequence[Table]
    search: Figure | None
    found: Table | None
    most: int
    front: int
    tried: int
    links: Sequence[tuple[str, str]]


def tradeoff_section(store: Store, found: Mapping[str, Json]) -> TradeoffSection:
    """Show the searches for speed and error.

    Args:
        found: by name in `RESULTS`.

    Raises:
        StoreError: a file is of another shape.
    """
    titles = {
        "scene": "the scene",
        "labels": "the labels",
        "labels_truth": "the labels",
        "detector": "the detector",
    }
    scene, scene_figure, search, table, front, tried = None, None, None, None, 0, 0
    if "scene" in found:
        with RESULTS["scene"].shape_checked():
            scene = scene_cost(found["scene"])
            data = _scene_data(found["scene"]["variants"])
            scene_figure = replace(scene.figure, name="tradeoff-scene", data=data)
    tables = []
    for name, make in (("labels", label_speed), ("labels_truth", label_truth)):
        if name in found:
            with RESULTS[name].shape_checked():
                tables.append(make(found[name]["figures"]))
    if "detector" in found:
        with RESULTS["detector"].shape_checked():
            rows = list(found["detector"]["rows"])
            search = _draw_search(rows, simulated=bool(found["detector"]["simulated"]))
            table, front = _search_table(rows)
            tried = len(rows)
    links = []
    for name, subject in (("scene", "the scene's"), ("detector", "the detector's")):
        file = (store.folder / RESULTS[name].file).with_suffix(".html")
        if name in found and file.exists():
            address = os.path.relpath(file, store.folder / "report").replace(os.sep, "/")
            links.append((address, f"The whole of {subject} search"))
    return TradeoffSection(
        [(titles[name], RESULTS[name].command(store)) for name in titles if name not in found],
        found["scene"]["protocol"] if scene is not None else None,
        scene,
        scene_figure,
        tables,
        search,
        table,
        MOST,
        front,
        tried,
        links,
    )


def _scene_data(rows: Sequence[Json]) -> dict[str, Sequence[object]]:
    def heading(key: str) -> str:
        """A heading with its unit from a key that ends with it."""
        for ending, unit in (("_ms", "ms"), ("_us", "µs")):
            if key.endswith(ending):
                return f"{key.removesuffix(ending).replace('_', ' ')} ({unit})"
        return f"{key.replace('_', ' ')} (share)"

    return {
        "family": [row["family"] for row in rows],
        "variant": [row["name"] for row in rows],
        "wall time of a trial (s)": [row["wall_s"] for row in rows],
        **{heading(key): [row["error"].get(key) for row in rows] for key in rows[0]["error"]},
    }


TRACKERS = {
    "": "SlipLab's tracker",
    "tuned_detector_": "OpenCV's blob detector, tuned to these frames",
    "components_": "OpenCV's connected components, weighted by intensity",
    "blob_detector_": "OpenCV's blob detector as it stands",
}
"""Prefixes of figures of the benchmark `labels`, one a method to find markers."""

SETS = {"": "slides", "falls_": "falling plates", "stressed_": "slides with nuisances"}
"""Beginnings of figures of the benchmark `labels_truth`, a set of trials each."""

TRUTHS = {
    "trials": "trials",
    "slips": "slips of single markers",
    "centroid_rms_px": "centres, RMS error (px)",
    "swaps": "markers taken for each other",
    "crossing_median_frames": "paper's rule against the true crossing, median (frames)",
    "crossing_p95_frames": "the same, 95th percentile (frames)",
    "paper_slip_median_ms": "paper's rule against the true start of slip, median (ms)",
    "slip_median_ms": "change point against the true start of slip, median (ms)",
    "slip_p95_ms": "the same, 95th percentile (ms)",
    "slip_bias_ms": "the same, median with its sign (ms)",
    "slip_width_ms": "width of its 95 % interval, median (ms)",
    "coverage_95": "share of these intervals that hold the truth",
    "wrong_not_doubted": "onsets of trials that are wrong without a doubt",
}


def label_speed(figures: Json) -> Table:
    """List the time per frame and the error of each method to find markers.

    Raises:
        KeyError: SlipLab's own are not among the figures.
    """
    own = float(figures["frame_ms"])
    rows = []
    for begin, words in TRACKERS.items():
        if f"{begin}frame_ms" in figures:
            ms = float(figures[f"{begin}frame_ms"])
            error = _format(figures.get(f"{begin}error_px"))
            rows.append([words, f"{ms:.3g}", f"{ms / own:.3g}", error])
    return Table(
        ("way to find the markers", "a frame (ms)", "times SlipLab's", "RMS error (px)"),
        rows,
        "The labels: following the markers on drawn frames, one core (simulated; errors on frames "
        "without noise).",
    )


def label_truth(figures: Json) -> Table:
    """List the errors of labels against the simulation's truth, by set of trials.

    Raises:
        KeyError: no set of trials is among the figures.
    """
    sets = {begin: words for begin, words in SETS.items() if f"{begin}trials" in figures}
    if not sets:
        raise KeyError("trials")
    rows = []
    for key, words in TRUTHS.items():
        values = [figures.get(f"{begin}{key}") for begin in sets]
        if any(value is not None for value in values):
            rows.append([words, *map(_format, values)])
    return Table(
        ("labels against the truth", *sets.values()),
        rows,
        "The labels: pictures drawn of random trials, and what was found in them (simulated).",
    )


def _format(value: Any) -> str:
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.3g}"


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


def _scaled(row: Json, key: tuple[str, str]) -> float | None:
    """Return the mean over seeds; None where one is missing."""
    values = row[key[0]].get(key[1]) or []
    if not values or any(value is None for value in values):
        return None
    return FIGURES[key][1] * float(np.mean(values))


def _draw_search(rows: Sequence[Json], *, simulated: bool) -> Figure:
    cost = ("work", "us_per_s")
    panels = [
        Panel(cost[1], key[1], FIGURES[cost][0], f"{FIGURES[key][0]}, test trials")
        for key in (("test", "mean_ms"), ("test", "strict"))
    ]
    points = [
        Point(
            {key[1]: _scaled(row, key) for key in FIGURES}, bool(row["front"]), bool(row["paper"])
        )
        for row in rows
    ]
    data: dict[str, Sequence[object]] = {
        **{heading: [row[name] for row in rows] for name, heading in SETTINGS.items()},
        **{FIGURES[key][0]: [_scaled(row, key) for row in rows] for key in FIGURES},
        "on the front": [row["front"] for row in rows],
    }
    svg = cost_and_error(points, panels, simulated=simulated)
    return Figure(svg, name="tradeoff-detector", data=data)


def _search_table(rows: Sequence[Json]) -> tuple[Table, int]:
    """List the paper's settings and the front, by latency; and count them."""
    shown = [row for row in rows if row["paper"]] + sorted(
        (row for row in rows if row["front"] and not row["paper"]),
        key=lambda row: _scaled(row, ("test", "mean_ms")) or float("inf"),
    )
    words = (
        "{length_ms} ms in steps of {step_ms} ms, cells of {pool_px} px, width ×{width:g}, "
        "{precision}; every {stride_ms} ms, {smoothing} windows, margin {margin:g}"
    )
    cells = [
        [
            "paper's" if row["paper"] else "front",
            words.format(**row),
            *(number(_scaled(row, key), digits) for key, (_, _, digits) in FIGURES.items()),
        ]
        for row in shown[:MOST]
    ]
    columns = ("", "detector", *(heading for heading, _, _ in FIGURES.values()))
    return Table(columns, cells), len(shown)


def _found(store: Store) -> dict[str, Json]:
    found = {name: result.read(store) for name, result in RESULTS.items()}
    return {name: result for name, result in found.items() if result is not None}


def _make(data: ReportData) -> TradeoffSection | None:
    if data.collected is None:
        return None
    return tradeoff_section(data.store, _found(data.store))


def _key(store: Store, campaigns: Sequence[Collected]) -> list[Any]:
    return list(_found(store).items())


SECTION = ReportSection(_make, _key, last=True)
"""Trade-offs in the report."""
