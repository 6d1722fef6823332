"""`sliplab bench`: detectors of slip on the open bench; its table, plot and leaderboard."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.plugins.bench.definition import SEEDS
from sliplab.plugins.bench.document import BenchDetector, BenchResult, MedianLatency
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.schema.evaluation import AlarmRate

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

PLOT, IMAGES = "bench.svg", "images"
COLUMNS = (
    "detector",
    "latency (ms)",
    "from 2 px (ms)",
    "missed (early)",
    "false alarms/h",
    "with nuisances",
    "accuracy (%)",
    "operations",
    "memory (B)",
    "decision (us)",
)
COSTS = 7
"""Column of the first cost; on a page costs have a table of their own."""
PAGE_TEST = "Page's test on the slipping marker alone, which expects slip at any moment,"
BEGIN, END = "<!-- bench: written by `sliplab bench` -->", "<!-- bench: end -->"


def measure(
    detectors: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="DETECTOR...",
            help="Names of shipped detectors, MODULE:ATTRIBUTE, files that end in .onnx, or "
            "run:COMMAND; default: all that ship.",
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", min=0, max=SEEDS - 1, help="Of the test worlds; default: drawn, and printed."
        ),
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="Fewer scenes, for a first look.")] = False,
    worlds: Annotated[
        str,
        typer.Option(
            "--worlds",
            help="Worlds of the scenes: usual, creep, stick-slip, texture, curved, or hard: all.",
        ),
    ] = "usual",
    folder: Annotated[
        Path, typer.Option("--folder", help="Keeps the results, so that a run resumes.")
    ] = Path("sliplab-bench"),
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, max=1024, help="Processes; default: one a core."),
    ] = None,
    leaderboard: Annotated[
        Path | None,
        typer.Option("--leaderboard", help="Also write the table into this page (Markdown)."),
    ] = None,
) -> Finding[BenchResult]:
    """Judge detectors on simulated scenes: latency at a false alarm an hour, and its cost."""
    from sliplab.analysis.detectors.registry import CORE
    from sliplab.plugins.bench import PLUGIN
    from sliplab.plugins.bench.plot import latency_against_alarms
    from sliplab.plugins.bench.run import run_bench

    if leaderboard is not None:
        _around(leaderboard)  # wrong input fails before anything is simulated
    size, names = "small" if small else "full", detectors or (*CORE, *PLUGIN.detectors)
    found = run_bench(names, size, seed, folder, workers or os.cpu_count() or 1, worlds)
    svg = latency_against_alarms(found)
    if leaderboard is not None:
        _write_leaderboard(leaderboard, found, svg)
    write_text(folder / PLOT, svg)
    return Finding(found, folder, more=(folder / PLOT,))


def shown(found: BenchResult, plot: Path) -> Iterator[Table | str]:
    """Yield the table, the note on its intervals, and where the plot is."""
    from sliplab.analysis.report.page import Table

    title = (
        f"bench {found.version}, {found.size}, seed {found.seed}, {found.worlds} worlds (simulated)"
    )
    yield Table(COLUMNS, [_row(row) for row in found.detectors], title)
    yield _interval_note(found)
    yield f"Latency against false alarms (simulated): {plot.resolve()}"


def view(found: BenchResult, plot: Path) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.page import Figure, Table

    detectors, costs = (Table(head, rows) for head, *rows in _tables(found))
    return {
        "note": _interval_note(found),
        "detectors": detectors,
        "latencies": Figure(plot.read_text("utf-8")),
        "costs": costs,
    }


def _interval_note(found: BenchResult) -> str:
    """Return the note on the table's intervals: their units, and where they may be too narrow."""
    from sliplab.analysis.metrics.alarm_rates import few_words

    rates = [row.disturbed for row in found.detectors if row.disturbed is not None]
    disturbed = [rate.clusters for rate in rates if rate.clusters]
    worlds = max(row.table.test.worlds for row in found.detectors)
    text = f"Intervals are 95 %, over {plural(worlds, 'test world')}"
    if disturbed:
        text += f" and {max(disturbed)} with nuisances"
    few = few_words(min([worlds, *disturbed]))
    text = f"{text}; {few}." if few else f"{text}."
    if found.limit is not None:
        known = _median(found.limit.points[0].latency_ms).replace(" (", " ms (")
        text += f" {PAGE_TEST} needs {known}."
    if found.alone is False:
        text += " This system let detectors see other processes."
    return text


def _tables(found: BenchResult) -> tuple[list[list[str]], list[list[str]]]:
    """Return the table and that of the costs, each with its head."""
    every = [list(COLUMNS), *map(_row, found.detectors)]
    return [row[:COSTS] for row in every], [[row[0], *row[COSTS:]] for row in every]


def _row(row: BenchDetector) -> list[str]:
    """Return a detector as a row below `COLUMNS`."""
    test = row.table.test
    return [
        row.name,
        _median(test.latency_ms),
        _median(test.latency_paper_ms),
        f"{test.missed}/{test.slides} ({test.early})",
        _rate(test.false_alarms, 1),
        "–" if row.disturbed is None else _rate(row.disturbed, 0),
        "–" if row.accuracy is None else f"{100 * row.accuracy:.1f}",
        "–" if row.operations is None else f"{row.operations:,.0f}",
        "–" if row.memory_bytes is None else f"{row.memory_bytes:,}",
        f"{row.decision_us:.0f}",
    ]


def _median(found: MedianLatency) -> str:
    """Return a median with its interval; a dash for infinite values."""
    if found.value is None:
        return "–"
    low, high = ("–" if it is None else f"{it:.0f}" for it in (found.low, found.high))
    return f"{found.value:.0f} ({low} to {high})"


def _rate(found: AlarmRate, digits: int) -> str:
    """Return a rate with its interval; alone where so few worlds bound nothing."""
    value = f"{found.value:.{digits}f}"
    if found.low is None or found.high is None:
        return value
    return f"{value} ({found.low:.{digits}f} to {found.high:.{digits}f})"


def _write_leaderboard(page: Path, found: BenchResult, svg: str) -> None:
    """Write the table into a page, between its two comments, and the plot next to it."""
    before, after = _around(page)
    detectors, costs = _tables(found)
    scenes, hours = found.scenes, found.hours
    text = [
        BEGIN,
        "",
        f"`{found.command}`, scenes of version {found.version}, **simulated**: "
        f"{scenes['train']} training, {scenes['validation']} validation and "
        f"{plural(scenes['test'], 'test scene')}, {hours['validation']:.2f} and "
        f"{hours['test']:.2f} hours without slip. {_interval_note(found)}",
        "",
        *_markdown(detectors),
        "",
        f"![Latency against false alarms, simulated]({IMAGES}/{PLOT})",
        "",
        *_markdown(costs),
        "",
        END,
    ]
    make_folder(page.parent / IMAGES)
    write_text(page.parent / IMAGES / PLOT, svg)
    write_text(page, before + "\n".join(text) + after)


def _markdown(table: list[list[str]]) -> list[str]:
    """Return the lines of a table; its first row is the head."""
    head, *body = table
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body)]


def _around(page: Path) -> tuple[str, str]:
    """Return a page's text before and after its table.

    Raises:
        InputError: it cannot be read, or has no place for a table.
    """
    try:
        text = page.read_text("utf-8")
    except FileNotFoundError:
        raise InputError("--leaderboard", "", str(page), "no such file") from None
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise InputError(
            "--leaderboard", "", str(page), f"must have the lines {BEGIN} and {END} for the table"
        )
    return before, after


STUDY = Study(
    name="bench",
    title="The table of the bench of detectors, by SlipLab",
    measure=measure,
    result=BenchResult,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab bench --small",
)
