"""Page of the detector's search: tables and plots, made from its numbers alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from sliplab.analysis.report.figures.tradeoffs import (
    Bar,
    Panel,
    Point,
    factor_lines,
    front_panels,
)
from sliplab.analysis.report.page import Figure, Section, Table, number, percent, render_page
from sliplab.analysis.report.prose import paragraph, paragraphs
from sliplab.analysis.sweeps.detector_rows import (
    FACTORS,
    LOOSE,
    MOST_MISSED,
    OBJECTIVES,
    Row,
    mean,
    short_list,
)

MOST_ROWS = 40
"""Of the front on the page; the table as CSV has all."""
COLUMNS = (
    "network", "precision", "stride (ms)", "windows", "margin (spikes)", "strict (%)",
    "mean latency (ms)", "95 % (ms)", "false early (%)", "missed or late (%)", "µs a window",
    "in a batch", "operations a window (1000)", "operations/s (million)",
)  # fmt: skip
TERMINAL = ("", "network", "stride", "rule", "strict", "latency", "early", "missed or late")
_LATENCY, _OPERATIONS = "mean incipient latency (ms)", "synaptic operations/s (million)"
_TIME = "computing time (ms a second, one thread)"
PANELS = (
    Panel("mean_ms", "strict", _LATENCY, "strict accuracy (%)"),
    Panel("mean_ms", "false_early_either", _LATENCY, "false early trials (%)"),
    Panel("synaptic_operations_per_s", "strict", _OPERATIONS, "strict accuracy (%)", True),
    Panel("synaptic_operations_per_s", "mean_ms", _OPERATIONS, _LATENCY, True),
    Panel("us_per_s", "p95_ms", _TIME, "95th percentile latency (ms)", True),
    Panel("us_per_s", "lost_either", _TIME, "missed or late trials (%)", True),
)
DRAWN = {
    **dict.fromkeys(("strict", "false_early_either", "lost_either"), 100.0),
    "us_per_s": 1e-3,
    "synaptic_operations_per_s": 1e-6,
}
"""Factors on figures in the plots."""

_prose = partial(paragraphs, "tradeoff_detector.txt")
_caption = partial(paragraph, "tradeoff_detector.txt")
Result = Mapping[str, Any]


def render(result: Result) -> str:
    """Return the page as text; everything in it is escaped but the figures' SVG."""
    return render_page(
        "tradeoff_detector.html", make_sections(result), simulated=result["simulated"],
        kept=result["kept"], runs=result["runs"],
    )  # fmt: skip


def make_sections(result: Result) -> list[Section]:
    """Return the sections of the page, in order."""
    rows, simulated = rows_of(result), result["simulated"]
    sections = [_tried(result)]
    if rows:
        sections += [_short_list(rows), _front(rows, bool(result["trials"]["falling"]))]
        sections += [_plots(rows, simulated), _factors(rows, result["comparisons"], simulated)]
        sections += [_cross(rows), _pairs(result["pairs"])]
    return [section for section in sections if section.tables or section.figures or section.text]


def rows_of(result: Result) -> list[Row]:
    """Return the rows of a result."""
    return [Row.of_json(row) for row in result["rows"]]


def _tried(result: Result) -> Section:
    left_out = [[name, why] for name, why in result["left_out"].items()]
    warned = [[name, "; ".join(each)] for name, each in result["warnings"].items()]
    tables = [Table(("left out", "why"), left_out)] if left_out else []
    tables += [Table(("network", "warning"), warned)] if warned else []
    return Section("What was tried", _prose("tried", loose=LOOSE, **result), (), tables)


def _short_list(rows: Sequence[Row]) -> Section:
    found = [[percent(budget, 0), *cells(row)] for budget, row in short_list(rows)]
    text = _prose("short_list", most_missed=MOST_MISSED, found=found)
    tables = [Table(("budget", *COLUMNS), found)] if found else []
    return Section("A short list", text, (), tables)


def _front(rows: Sequence[Row], falling: bool) -> Section:
    once = distinct(rows)
    on = sum(row.front for row in once)
    both = sum(row.front and row.front_validation for row in once)
    paper = next((row for row in once if row.paper), None)
    shown, columns = ordered_front(rows, MOST_ROWS), list(COLUMNS)
    table = [cells(row) for row in shown]
    if falling:
        columns.append("shortest lead (ms)")
        leads = [number(mean((row.falling or {})["lead_min_ms"]), 0) for row in shown]
        table = [[*each, lead] for each, lead in zip(table, leads, strict=True)]
    text = _prose("front", on=on, rows=len(once), both=both, paper=paper, falling=falling)
    caption = _caption("front_caption", on=on, most=MOST_ROWS, falling=falling)
    return Section("The Pareto front", text, (), [Table(columns, table, caption)])


def _plots(rows: Sequence[Row], simulated: bool) -> Section:
    def values(row: Row) -> dict[str, float | None]:
        found = {name: row.objective(name) for name in OBJECTIVES}
        return {k: None if v is None else DRAWN.get(k, 1.0) * v for k, v in found.items()}

    points = [Point(values(row), row.front, row.paper) for row in rows]
    svg = front_panels(points, PANELS, simulated=simulated)
    return Section("Speed, work and error", [], [Figure(svg, _caption("plots_caption"))])


def _factors(
    rows: Sequence[Row], comparisons: Sequence[Mapping[str, Any]], simulated: bool
) -> Section:
    bars: dict[str, list[Bar]] = {title: [] for title in FACTORS.values()}
    table = []
    for item in comparisons:
        row, title, found = rows[item["row"]], FACTORS[item["factor"]], item["difference"]
        strict, late = row.test["strict"], row.test["mean_ms"]
        ranges = {"strict": seed_range(strict, 100), "mean_ms": seed_range(late, 1)}
        value = item["value"] if isinstance(item["value"], str) else f"{item['value']:g}"
        bars[title].append(Bar(value, item["paper"], ranges))
        if item["paper"] or found is None:
            shown = ["paper's" if item["paper"] else "–"] * 3
        else:
            shown = [
                format_difference(found["strict"], 100, "points"),
                format_difference(found["mean_ms"], 1, "ms"),
                format_difference(found["false_early_either"], 100, "points"),
            ]
        table.append([f"{title}: {value}", spread(strict, 100, 1), spread(late, 1, 0), *shown])
    drawn = {title: each for title, each in bars.items() if each}
    figures = {"strict": "strict accuracy (%)", "mean_ms": "mean latency (ms)"}
    svg = factor_lines(drawn, figures, simulated=simulated)
    columns = ("factor", "strict (%)", "mean latency (ms)", "strict, difference",
               "latency, difference", "false early, difference")  # fmt: skip
    text = _prose("factors", seeds=max((len(row.seeds) for row in rows), default=0))
    figure = Figure(svg, _caption("factors_caption"))
    return Section("One factor at a time", text, [figure], [Table(columns, table)])


def _cross(rows: Sequence[Row]) -> Section:
    """Window length by pooling."""
    there = {
        (row.setting.length_ms, row.setting.pool_px): [
            f"{hundred(mean(row.test['strict']))} %",
            f"{number(mean(row.test['mean_ms']), 0)} ms",
            f"{scaled(mean(row.work['synaptic_operations_per_s']), 1e6)} M/s",
        ]
        for row in rows
        if row.precision == "trained" and row.rule == "chosen"
        and row.stride_ms == row.setting.length_ms
        and (row.setting.step_ms, row.setting.width) == (1, 1)
    }  # fmt: skip
    lengths, pools = (sorted({key[k] for key in there}) for k in (0, 1))
    table = [
        [f"{length} ms", *(", ".join(there.get((length, pool), ["–"])) for pool in pools)]
        for length in lengths
    ]
    columns = ["window", *(f"cells of {pool} px" for pool in pools)]
    tables = [Table(columns, table, _caption("cross_caption"))]
    return Section("Window length and pooling", (), (), tables)


def _pairs(pairs: Sequence[Mapping[str, Any]]) -> Section:
    found = {
        (pair["smoothing"], pair["margin"]): f"{number(pair['mean_ms'], 0)} ms, "
        f"{hundred(pair['false_early_either'], 0)} / {hundred(pair['lost_either'], 0)} %"
        for pair in pairs
    }
    smoothings, margins = (sorted({key[k] for key in found}) for k in (0, 1))
    table = [[f"{s}", *(found[s, margin] for margin in margins)] for s in smoothings]
    columns = ["windows", *(f"margin {margin:g}" for margin in margins)]
    tables = [Table(columns, table, _caption("pairs_caption"))] if table else []
    title = "Smoothing and margin with the paper's windows"
    return Section(title, _prose("pairs"), (), tables)


def distinct(rows: Sequence[Row]) -> list[Row]:
    """Return each detector once: two rules may have chosen the same pair."""
    found: dict[Any, Row] = {}
    for row in rows:
        found.setdefault(row.detector, row)
    return list(found.values())


def ordered_front(rows: Sequence[Row], most: int | None = None) -> list[Row]:
    """Return the paper's row, then the front by mean latency: at most so many of it."""

    def late(row: Row) -> tuple[bool, float]:
        value = row.objective("mean_ms")
        return value is None, value or 0

    front = [row for row in distinct(rows) if row.front and not row.paper]
    return [*(row for row in rows if row.paper), *sorted(front, key=late)[:most]]


def short_table(result: Result) -> tuple[Sequence[str], list[list[str]]]:
    """Return the paper's row and the short list for a terminal: columns and rows; means only."""
    rows = rows_of(result)
    wanted = [("paper's", row) for row in rows if row.paper]
    wanted += [(percent(budget, 0), row) for budget, row in short_list(rows)]
    table = []
    for name, row in wanted:
        setting, test = row.setting, row.test
        network = f"{setting.length_ms}/{setting.step_ms}/{setting.pool_px}/{setting.width:g}"
        table.append(
            [
                name,
                network + (", 8 bit" if row.precision == "8 bit" else ""),
                f"{row.stride_ms} ms",
                f"{row.smoothing}, {row.margin:g}",
                percent(mean(test["strict"])),
                number(mean(test["mean_ms"]), 0, "ms"),
                percent(mean(test["false_early_either"])),
                percent(mean(test["lost_either"])),
            ]
        )
    return TERMINAL, table


def cells(row: Row) -> list[str]:
    """Return a row as text under `COLUMNS`."""
    setting, test, work = row.setting, row.test, row.work
    name = f"{setting.length_ms}/{setting.step_ms} ms, {setting.pool_px} px, ×{setting.width:g}"
    both = row.front and row.front_validation
    return [
        f"{'★ ' if row.paper else ''}{name}{' ✓' if both else ''}",
        row.precision,
        str(row.stride_ms),
        str(row.smoothing),
        f"{row.margin:g}",
        spread(test["strict"], 100, 1),
        spread(test["mean_ms"], 1, 0),
        number(mean(test["p95_ms"]), 0),
        f"{hundred(mean(test['false_early_either']))} "
        f"({hundred(mean(test['false_early']), 0)}, {hundred(mean(test['false_early_gross']), 0)})",
        hundred(mean(test["lost_either"])),
        number(mean(work["us_single"]), 0),
        number(mean(work["us_batched"]), 0),
        scaled(mean(work["synaptic_operations"]), 1e3),
        scaled(mean(work["synaptic_operations_per_s"]), 1e6),
    ]


def seed_range(values: Sequence[float | None], scale: float) -> tuple[float, float, float] | None:
    """Return mean, lowest and highest over seeds; None without any."""
    there = [scale * value for value in values if value is not None]
    return (sum(there) / len(there), min(there), max(there)) if there else None


def spread(values: Sequence[float | None], scale: float, digits: int) -> str:
    """Return mean, lowest and highest in words; of one seed its value."""
    found = seed_range(values, scale)
    if found is None:
        return "–"
    text = f"{found[0]:.{digits}f}"
    return text if len(values) < 2 else f"{text} ({found[1]:.{digits}f} to {found[2]:.{digits}f})"


def format_difference(difference: Mapping[str, Any], scale: float, unit: str) -> str:
    """Return a difference, its interval, and its significance over seeds, in words."""
    if difference["mean"] is None:
        return "–"
    text = f"{scale * difference['mean']:+.1f}".replace("-", "−")
    if difference["told"] is None:
        return f"{text} {unit}"
    half = scale * (difference["high"] - difference["mean"])
    return f"{text} ± {half:.1f} {unit}{', more than seeds' if difference['told'] else ''}"


def hundred(value: float | None, digits: int = 1) -> str:
    """Return a share in percent, without the sign."""
    return "–" if value is None else f"{100 * value:.{digits}f}"


def scaled(value: float | None, by: float) -> str:
    """Return three digits in units of `by`."""
    return "–" if value is None else f"{value / by:.3g}"
