"""The table of the bench, its plot, and the leaderboard in a page of the documentation."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.metrics.alarm_rates import few_words
from sliplab.plugins.bench.document import BenchDetector, BenchResult, MedianLatency
from sliplab.plugins.bench.registry import SHIPPED as _SHIPPED
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural
from sliplab.storage.files import make_folder, write_text
from sliplab.storage.schema.evaluation import AlarmRate

SHIPPED = tuple(_SHIPPED)
PLOT = "bench.svg"
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
BEGIN, END = "<!-- bench: written by `sliplab bench` -->", "<!-- bench: end -->"
IMAGES = "images"


def title(found: BenchResult) -> str:
    """Return the table's title."""
    return f"bench {found.version}, {found.size}, seed {found.seed} (simulated)"


def interval_note(found: BenchResult) -> str:
    """Return the note on the table's intervals: their units, and where they may be too narrow."""
    tests = [row.table.test for row in found.detectors]
    rates = [row.disturbed for row in found.detectors if row.disturbed is not None]
    disturbed = [rate.clusters for rate in rates if rate.clusters]
    worlds = max(it.worlds for it in tests)
    text = f"Intervals are 95 %, over {plural(worlds, 'test world')}"
    if disturbed:
        text += f" and {max(disturbed)} with nuisances"
    few = few_words(min([worlds, *disturbed]))
    return f"{text}; {few}." if few else f"{text}."


def rows(found: BenchResult) -> list[list[str]]:
    """Return a row of text for each detector, the best first; see `COLUMNS`."""
    return [_row(row) for row in found.detectors]


def _row(row: BenchDetector) -> list[str]:
    test = row.table.test
    alarms = test.false_alarms
    return [
        row.name,
        _median(test.latency_ms),
        _median(test.latency_paper_ms),
        f"{test.missed}/{test.slides} ({test.early})",
        _rate(alarms, 1),
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


def write_plot(path: Path, found: BenchResult) -> None:
    """Draw latency against false alarms."""
    from sliplab.plugins.bench.plot import latency_against_alarms

    write_text(path, latency_against_alarms(found))


def check_page(page: Path) -> None:
    """Check that a page has a place for the table.

    Raises:
        InputError: it cannot be read, or has no such place.
    """
    _around(page)


def write_leaderboard(page: Path, found: BenchResult) -> None:
    """Write the table into a page, between its two comments, and the plot next to it.

    Raises:
        InputError: as `check_page`.
    """
    before, after = _around(page)
    every = [list(COLUMNS), *rows(found)]
    hours = found.hours
    command = "sliplab bench" + (" --small" if found.size == "small" else "")
    text = [
        BEGIN,
        "",
        f"`{command} --seed {found.seed}`, scenes of version {found.version}, **simulated**: "
        f"{found.scenes['train']} training, {found.scenes['validation']} validation and "
        f"{plural(found.scenes['test'], 'test scene')}, {hours['validation']:.2f} and "
        f"{hours['test']:.2f} "
        f"hours without slip. {interval_note(found)}",
        "",
        *_markdown([row[:COSTS] for row in every]),
        "",
        f"![Latency against false alarms, simulated]({IMAGES}/{PLOT})",
        "",
        *_markdown([[row[0], *row[COSTS:]] for row in every]),
        "",
        END,
    ]
    make_folder(page.parent / IMAGES)
    write_plot(page.parent / IMAGES / PLOT, found)
    write_text(page, before + "\n".join(text) + after)


def _markdown(table: list[list[str]]) -> list[str]:
    """Return the lines of a table; its first row is the head."""
    head, *body = table
    return [f"| {' | '.join(cells)} |" for cells in (head, ["---"] * len(head), *body)]


def _around(page: Path) -> tuple[str, str]:
    """Return a page's text before and after its table."""
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
