"""Results of other commands in the report, if they exist in the store.

They take minutes to hours, so the report never computes them: it shows existing results, and names
the command for missing ones. It does not check whether they are up to date.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from sliplab.analysis.report.figures.intervals import Share, shares
from sliplab.analysis.report.figures.tradeoffs import Panel, Point, cost_and_error
from sliplab.analysis.report.page import Content, Figure, Table, number, percent
from sliplab.analysis.report.tradeoff_scene import SceneCost, scene_cost
from sliplab.analysis.report.windows import share_data
from sliplab.storage.errors import StoreError
from sliplab.storage.files import read_json
from sliplab.storage.schema.document import Document
from sliplab.storage.schema.sweeps import GeneralisationResults, NotTrained
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import Store

DocumentT = TypeVar("DocumentT", bound=Document)

FILES = {
    "generalisation": "derived/generalisation/results.json",
    "guesses": "derived/guesses/results.json",
    "holdout": "holdout/results.json",
    "stress": "stress/stress.json",
    "scene": "derived/tradeoff/tradeoff.json",
    "labels": "derived/tradeoff/labels.json",
    "labels_truth": "derived/tradeoff/labels_truth.json",
    "detector": "report/detector_tradeoff.json",
}
"""File in the store, by name."""

COMMANDS = {
    "generalisation": "sliplab generalise {store}",
    "guesses": "sliplab guesses {store}",
    "holdout": "sliplab holdout {store}",
    "stress": "sliplab stress {store}",
    "scene": "sliplab tradeoff --scene PROTOCOL --out {folder}",
    "labels": "python -m benchmarks labels --json > {file}",
    "labels_truth": "python -m benchmarks labels_truth --json > {file}",
    "detector": "sliplab tradeoff --detector {store}",
}
"""The command that makes each."""


def read_programs(store: Store) -> dict[str, Json]:
    """Read the results that there are, by name.

    Raises:
        StoreError: a file is there and cannot be read.
    """
    found = {}
    for name, place in FILES.items():
        path = store.folder / place
        try:
            found[name] = read_json(path)
        except FileNotFoundError:
            continue
        except (OSError, ValueError) as error:
            raise StoreError(f"{error}; delete {path}, or make it again") from None
    return found


def command(store: Store, name: str) -> str:
    """Return the command that makes one of `FILES`, for this store."""
    path = store.folder.resolve() / FILES[name]
    return COMMANDS[name].format(store=store.folder.resolve(), folder=path.parent, file=path)


@contextmanager
def shape_checked(name: str) -> Iterator[None]:
    """Name the file where its numbers are not of the shape that the block reads.

    Raises:
        StoreError: instead of what the block raised.
    """
    try:
        yield
    except (KeyError, TypeError, AttributeError, IndexError, ValueError) as error:
        raise StoreError(
            f"{FILES[name]}: is not of the shape that this version reads ({error!r}); delete it, "
            "or make it again"
        ) from None


def parse_program(name: str, kind: type[DocumentT], found: Json) -> DocumentT:
    """Return the results of a program as a document.

    Raises:
        StoreError: they are of another shape.
    """
    with shape_checked(name):
        return kind.parse(found, Path(FILES[name]))


@dataclass(frozen=True)
class SkinSection(Content):
    """The network on skins and levels that it never saw, or how to measure it."""

    template: ClassVar[str] = "skins.html"
    command: str
    figure: Figure | None = None
    table: Table | None = None
    seeds: str = ""


def skin_section(
    found: Json | None, command: str, strict: float | None, seeds: str = "", *, simulated: bool
) -> SkinSection:
    """Show the results of `sliplab generalise`.

    Args:
        strict: accuracy of the network on its own skin. seeds: that were trained there, in words.

    Raises:
        StoreError: they are of another shape.
    """
    if found is None:
        return SkinSection(command)
    groups: dict[str, list[Share]] = {}
    rows = []
    results = parse_program("generalisation", GeneralisationResults, found).results.items()
    for name, row in sorted(results, key=lambda each: each[0].startswith("skin ")):
        if isinstance(row, NotTrained):
            rows.append([name, row.why, "", "", "", ""])
            continue
        group = "other skins" if name.startswith("skin ") else f"without a {name.split()[0]}"
        item = Share(name, row.share, row.low, row.high)
        groups.setdefault(group, []).append(item)
        span = "–" if item.low is None else f"{percent(item.low)} to {percent(item.high)}"
        rows.append([name, str(row.trials), str(row.n), percent(item.value), span,
                     percent(row.seen)])  # fmt: skip
    figure = None
    if groups:
        drawn = [item for of in groups.values() for item in of]
        line = None if strict is None else (strict, "this network, its own skin")
        svg = shares(groups, "windows classified correctly (%)", simulated=simulated, line=line)
        figure = Figure(svg, name="skins", data=share_data(drawn))
    columns = ("left out, or skin", "trials", "windows", "right", "95 %", "levels that were seen")
    return SkinSection(command, figure, Table(columns, rows), seeds)


@dataclass(frozen=True)
class TradeoffSection(Content):
    """Speed against error of scene, labels and detector, as far as they were measured.

    Attributes:
        missing: name of what was not measured, and its command.
        protocol: of the scene, and what its search says; None without one.
    """

    template: ClassVar[str] = "tradeoff.html"
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
        found: by name in `FILES`.

    Raises:
        StoreError: a file is of another shape.
    """
    titles = {"scene": "the scene", "labels": "the labels", "labels_truth": "the labels",
              "detector": "the detector"}  # fmt: skip
    scene, scene_figure, search, table, front, tried = None, None, None, None, 0, 0
    if "scene" in found:
        with shape_checked("scene"):
            scene = scene_cost(found["scene"])
            data = _scene_data(found["scene"]["variants"])
            scene_figure = replace(scene.figure, name="tradeoff-scene", data=data)
    tables = []
    for name, make in (("labels", label_speed), ("labels_truth", label_truth)):
        if name in found:
            with shape_checked(name):
                tables.append(make(found[name]["figures"]))
    if "detector" in found:
        with shape_checked("detector"):
            rows = list(found["detector"]["rows"])
            search = _draw_search(rows, simulated=bool(found["detector"]["simulated"]))
            table, front = _search_table(rows)
            tried = len(rows)
    links = []
    for name, subject in (("scene", "the scene's"), ("detector", "the detector's")):
        file = (store.folder / FILES[name]).with_suffix(".html")
        if name in found and file.exists():
            address = os.path.relpath(file, store.folder / "report").replace(os.sep, "/")
            links.append((address, f"The whole of {subject} search"))
    return TradeoffSection(
        [(titles[name], command(store, name)) for name in titles if name not in found],
        found["scene"]["protocol"] if scene is not None else None,
        scene, scene_figure, tables, search, table, MOST, front, tried, links,
    )  # fmt: skip


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
"""Beginnings of figures of the benchmark `labels`, a way to find markers each."""

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
    """List time a frame and error of each way to find markers.

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
    """List how far labels are off what is true in the simulation, by set of trials.

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
