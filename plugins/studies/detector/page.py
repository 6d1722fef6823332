"""Page of the detector's search: tables and plots, made from its numbers alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sliplab.analysis.report.page import Figure, Table, number, percent
from sliplab.plugins.studies.detector.document import (
    DetectorRow,
    DetectorTradeoff,
    FactorValue,
    RulePair,
    SeedDifference,
    mean,
)
from sliplab.plugins.studies.detector.rows import (
    FACTORS,
    LOOSE,
    MOST_MISSED,
    OBJECTIVES,
    short_list,
)
from sliplab.plugins.studies.plot import (
    AxisPair,
    DetectorPoint,
    FactorBar,
    factor_lines,
    front_panels,
)

MOST_ROWS = 40
"""Most rows of the front on the page; the table as CSV has all."""
COLUMNS = (
    "network",
    "precision",
    "stride (ms)",
    "windows",
    "margin (spikes)",
    "strict (%)",
    "mean latency (ms)",
    "95 % (ms)",
    "false early (%)",
    "missed or late (%)",
    "µs a window",
    "in a batch",
    "operations a window (1000)",
    "operations/s (million)",
)
TERMINAL = ("", "network", "stride", "rule", "strict", "latency", "early", "missed or late")
_LATENCY, _OPERATIONS = "mean incipient latency (ms)", "synaptic operations/s (million)"
_TIME = "computing time (ms a second, one thread)"
PANELS = (
    AxisPair("mean_ms", "strict", _LATENCY, "strict accuracy (%)"),
    AxisPair("mean_ms", "false_early_either", _LATENCY, "false early trials (%)"),
    AxisPair("synaptic_operations_per_s", "strict", _OPERATIONS, "strict accuracy (%)", True),
    AxisPair("synaptic_operations_per_s", "mean_ms", _OPERATIONS, _LATENCY, True),
    AxisPair("us_per_s", "p95_ms", _TIME, "95th percentile latency (ms)", True),
    AxisPair("us_per_s", "lost_either", _TIME, "missed or late trials (%)", True),
)
DRAWN = {
    **dict.fromkeys(("strict", "false_early_either", "lost_either"), 100.0),
    "us_per_s": 1e-3,
    "synaptic_operations_per_s": 1e-6,
}
"""Factors on figures in the plots."""


def view(result: DetectorTradeoff) -> dict[str, object]:
    """Return what the page shows."""
    rows, simulated = result.rows, result.simulated
    detectors = distinct(rows)
    values: dict[str, object] = {
        "loose": LOOSE,
        "most_missed": MOST_MISSED,
        "not_tried": Table(("left out", "why"), [[*each] for each in result.left_out.items()]),
        "warned": Table(
            ("network", "warning"), [[run, "; ".join(of)] for run, of in result.warnings.items()]
        ),
        "detectors": detectors,
    }
    if rows:
        budgets = [[percent(budget, 0), *cells(row)] for budget, row in short_list(rows)]
        front = [row for row in detectors if row.front]
        comparisons = [(rows[item.row], item) for item in result.comparisons]
        values |= {
            "short_list": Table(("budget", *COLUMNS), budgets),
            "front": _front(rows, leads=bool(result.trials.falling)),
            "on_front": len(front),
            "on_both": sum(row.front_validation for row in front),
            "most": MOST_ROWS,
            "points": _points(rows, simulated),
            "seeds": max(len(row.seeds) for row in rows),
            "lines": _lines(comparisons, simulated),
            "factors": _factors(comparisons),
            "compared": sum(
                item.difference[name].low is not None
                for _, item in comparisons
                if item.difference is not None and not item.paper
                for name in _SHOWN
            ),
            "cross": _cross(rows),
            "pairs": _pairs(result.pairs),
        }
    return values


def _front(rows: Sequence[DetectorRow], *, leads: bool) -> Table:
    shown, columns = ordered_front(rows, MOST_ROWS), list(COLUMNS)
    table = [cells(row) for row in shown]
    if leads:
        columns.append("shortest lead (ms)")
        found = [number(mean((row.falling or {})["lead_min_ms"]), 0) for row in shown]
        table = [[*each, lead] for each, lead in zip(table, found, strict=True)]
    return Table(columns, table)


def _points(rows: Sequence[DetectorRow], simulated: bool) -> Figure:
    def values(row: DetectorRow) -> dict[str, float | None]:
        found = {name: row.objective(name) for name in OBJECTIVES}
        return {k: None if v is None else DRAWN.get(k, 1.0) * v for k, v in found.items()}

    points = [DetectorPoint(values(row), row.front, row.paper) for row in rows]
    return Figure(front_panels(points, PANELS, simulated=simulated))


Comparisons = Sequence[tuple[DetectorRow, FactorValue]]
"""Rows on the lines through the paper's setting."""


def _level(item: FactorValue) -> str:
    return item.value if isinstance(item.value, str) else f"{item.value:g}"


def _lines(comparisons: Comparisons, simulated: bool) -> Figure:
    bars: dict[str, list[FactorBar]] = {}
    for row, item in comparisons:
        ranges = {
            "strict": seed_range(row.test["strict"], 100),
            "mean_ms": seed_range(row.test["mean_ms"], 1),
        }
        bar = FactorBar(_level(item), item.paper, ranges)
        bars.setdefault(FACTORS[item.factor], []).append(bar)
    figures = {"strict": "strict accuracy (%)", "mean_ms": "mean latency (ms)"}
    return Figure(factor_lines(bars, figures, simulated=simulated))


_POINTS = (100, "points")
_SHOWN = {"strict": _POINTS, "mean_ms": (1, "ms"), "false_early_either": _POINTS}
"""Figures whose differences are shown, with their scale and unit."""


def _factors(comparisons: Comparisons) -> Table:
    table = []
    for row, item in comparisons:
        found = item.difference
        shown = ["paper's" if item.paper else "–"] * 3
        if found is not None and not item.paper:
            shown = [format_difference(found[name], *how) for name, how in _SHOWN.items()]
        means = [spread(row.test["strict"], 100, 1), spread(row.test["mean_ms"], 1, 0)]
        table.append([f"{FACTORS[item.factor]}: {_level(item)}", *means, *shown])
    columns = (
        "factor",
        "strict (%)",
        "mean latency (ms)",
        "strict, difference",
        "latency, difference",
        "false early, difference",
    )
    return Table(columns, table)


def _cross(rows: Sequence[DetectorRow]) -> Table:
    """Window length by pooling."""
    there = {
        (row.setting.length_ms, row.setting.pool_px): [
            f"{hundred(mean(row.test['strict']))} %",
            f"{number(mean(row.test['mean_ms']), 0)} ms",
            f"{scaled(mean(row.work['synaptic_operations_per_s']), 1e6)} M/s",
        ]
        for row in rows
        if row.precision == "trained"
        and row.rule == "chosen"
        and row.stride_ms == row.setting.length_ms
        and (row.setting.step_ms, row.setting.width) == (1, 1)
    }
    lengths, pools = (sorted({key[k] for key in there}) for k in (0, 1))
    table = [
        [f"{length} ms", *(", ".join(there.get((length, pool), ["–"])) for pool in pools)]
        for length in lengths
    ]
    return Table(["window", *(f"cells of {pool} px" for pool in pools)], table)


def _pairs(pairs: Sequence[RulePair]) -> Table:
    found = {
        (pair.smoothing, pair.margin): f"{number(pair.mean_ms, 0)} ms, "
        f"{hundred(pair.false_early_either, 0)} / {hundred(pair.lost_either, 0)} %"
        for pair in pairs
    }
    smoothings = sorted({pair.smoothing for pair in pairs})
    margins = sorted({pair.margin for pair in pairs})
    table = [[f"{s}", *(found[s, margin] for margin in margins)] for s in smoothings]
    return Table(["windows", *(f"margin {margin:g}" for margin in margins)], table)


def distinct(rows: Sequence[DetectorRow]) -> list[DetectorRow]:
    """Return each detector once: two rules may have chosen the same pair."""
    found: dict[Any, DetectorRow] = {}
    for row in rows:
        found.setdefault(row.detector, row)
    return list(found.values())


def ordered_front(rows: Sequence[DetectorRow], most: int | None = None) -> list[DetectorRow]:
    """Return the paper's row, then the front by mean latency: at most so many of it."""

    def late(row: DetectorRow) -> tuple[bool, float]:
        value = row.objective("mean_ms")
        return value is None, value or 0

    front = [row for row in distinct(rows) if row.front and not row.paper]
    return [*(row for row in rows if row.paper), *sorted(front, key=late)[:most]]


def short_table(result: DetectorTradeoff) -> Table:
    """Return the paper's row and the short list for a terminal; means only."""
    rows = result.rows
    listed = [("paper's", row) for row in rows if row.paper]
    listed += [(percent(budget, 0), row) for budget, row in short_list(rows)]
    table = []
    for name, row in listed:
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
    simulated = " (simulated)" if result.simulated else ""
    return Table(TERMINAL, table, f"The fastest detectors by false early trials{simulated}")


def cells(row: DetectorRow) -> list[str]:
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
    """Return mean, lowest and highest as text; of one seed its value."""
    found = seed_range(values, scale)
    if found is None:
        return "–"
    text = f"{found[0]:.{digits}f}"
    return text if len(values) < 2 else f"{text} ({found[1]:.{digits}f} to {found[2]:.{digits}f})"


def format_difference(difference: SeedDifference, scale: float, unit: str) -> str:
    """Return a difference, its interval, and its significance over seeds, as text."""
    if difference.mean is None:
        return "–"
    text = f"{scale * difference.mean:+.1f}".replace("-", "−")
    if difference.high is None:
        return f"{text} {unit}"
    half = scale * (difference.high - difference.mean)
    return f"{text} ± {half:.1f} {unit}{', more than seeds' if difference.told else ''}"


def hundred(value: float | None, digits: int = 1) -> str:
    """Return a share in percent, without the sign."""
    return "–" if value is None else f"{100 * value:.{digits}f}"


def scaled(value: float | None, by: float) -> str:
    """Return three digits in units of `by`."""
    return "–" if value is None else f"{value / by:.3g}"
