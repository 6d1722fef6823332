"""Rows of the detector's trade-off as text: for tables, for the terminal and for CSV."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sliplab.analysis.report.page import number, percent
from sliplab.flows.searching.detector_tradeoff_rows import Row, mean, objective, short_list

COLUMNS = (
    "network", "precision", "stride (ms)", "windows", "margin (spikes)", "strict (%)",
    "mean latency (ms)", "95 % (ms)", "false early (%)", "missed or late (%)", "µs a window",
    "in a batch", "operations a window (1000)", "operations/s (million)",
)  # fmt: skip
TERMINAL = ("", "network", "stride", "rule", "strict", "latency", "early", "missed or late")


def flat(row: Row, simulated: bool) -> dict[str, Any]:
    """A row for CSV: means over seeds, with lowest and highest; units in the names."""
    names = ("length_ms", "step_ms", "pool_px", "precision", "stride_ms", "rule")
    found: dict[str, Any] = {name: row[name] for name in names}
    found |= {"width_factor": row["width"], "smoothing_windows": row["smoothing"]}
    found |= {"margin_spikes": row["margin"], "seeds": len(row["seeds"])}
    parts = [(row["test"], "test", name) for name in row["test"]]
    parts += [
        (row["validation"], "validation", "strict"),
        (row["validation"], "validation", "mean_ms"),
    ]
    parts += [(row["falling"] or {}, "falling", name) for name in (row["falling"] or {})]
    parts += [(row["work"], "", name) for name in row["work"]]
    for values, prefix, name in parts:
        title = f"{prefix}_{name}".lstrip("_") + _UNITS.get(name, "")
        found[title] = mean(values[name])
        if prefix == "test" and name in ("strict", "mean_ms"):
            there = [value for value in values[name] if value is not None]
            found[f"{title}_lowest"] = min(there, default=None)
            found[f"{title}_highest"] = max(there, default=None)
    flags = ("paper", "front", "front_validation")
    return {**found, **{name: row[name] for name in flags}, "simulated": simulated}


_OUT = ("missed", "late", "lost", "false_early")
_SHARES = ("strict", *(f"{name}{of}" for name in _OUT for of in ("", "_gross", "_either")))
_UNITS = {
    **dict.fromkeys(_SHARES, "_share"),
    **dict.fromkeys(("us_single", "us_batched", "synaptic_operations"), "_per_window"),
    "trials": "_count",
}


def distinct(rows: Sequence[Row]) -> list[Row]:
    """Each detector once: two rules may have chosen the same pair."""
    names = (
        "length_ms", "step_ms", "pool_px", "width", "precision", "stride_ms", "smoothing", "margin"
    )  # fmt: skip
    found: dict[Any, Row] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in names), row)
    return list(found.values())


def ordered_front(result: Mapping[str, Any], most: int | None = None) -> list[Row]:
    """The paper's row, then the front by mean latency: at most so many of it."""
    paper = [row for row in result["rows"] if row["paper"]]
    front = [row for row in distinct(result["rows"]) if row["front"] and not row["paper"]]
    front.sort(key=lambda row: (objective(row, "mean_ms") is None, objective(row, "mean_ms") or 0))
    return [*paper, *front[:most]]


def front_rows(result: Mapping[str, Any], most: int | None = None) -> list[list[str]]:
    """The same as text under `COLUMNS`."""
    return [cells(row) for row in ordered_front(result, most)]


def short_table(result: Mapping[str, Any]) -> tuple[Sequence[str], list[list[str]]]:
    """The paper's row and the short list, for a terminal: columns and rows; means only."""
    wanted = [("paper's", row) for row in result["rows"] if row["paper"]]
    wanted += [(percent(budget, 0), row) for budget, row in short_list(result["rows"])]
    rows = []
    for name, row in wanted:
        test = row["test"]
        network = [f"{row[key]:g}" for key in ("length_ms", "step_ms", "pool_px", "width")]
        rows.append(
            [
                name,
                "/".join(network) + (", 8 bit" if row["precision"] == "8 bit" else ""),
                f"{row['stride_ms']} ms",
                f"{row['smoothing']}, {row['margin']:g}",
                percent(mean(test["strict"])),
                number(mean(test["mean_ms"]), 0, "ms"),
                percent(mean(test["false_early_either"])),
                percent(mean(test["lost_either"])),
            ]
        )
    return TERMINAL, rows


def _network(row: Row) -> str:
    name = f"{row['length_ms']}/{row['step_ms']} ms, {row['pool_px']} px, ×{row['width']:g}"
    return f"★ {name}" if row["paper"] else name


def cells(row: Row) -> list[str]:
    """A row as text under `COLUMNS`."""
    both = row["front"] and row["front_validation"]
    test, work = row["test"], row["work"]
    return [
        _network(row) + (" ✓" if both else ""),
        row["precision"],
        str(row["stride_ms"]),
        str(row["smoothing"]),
        f"{row['margin']:g}",
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
    """Mean, lowest and highest over seeds; None without any."""
    there = [scale * value for value in values if value is not None]
    return (sum(there) / len(there), min(there), max(there)) if there else None


def spread(values: Sequence[float | None], scale: float, digits: int) -> str:
    """The same in words; of one seed its value."""
    found = seed_range(values, scale)
    if found is None:
        return "–"
    text = f"{found[0]:.{digits}f}"
    return text if len(values) < 2 else f"{text} ({found[1]:.{digits}f} to {found[2]:.{digits}f})"


def format_difference(difference: Mapping[str, Any], scale: float, unit: str) -> str:
    """Format a difference, its interval, and its significance over seeds."""
    if difference["mean"] is None:
        return "–"
    text = f"{scale * difference['mean']:+.1f}".replace("-", "−")
    if difference["told"] is None:
        return f"{text} {unit}"
    half = scale * (difference["high"] - difference["mean"])
    return f"{text} ± {half:.1f} {unit}{', more than seeds' if difference['told'] else ''}"


def hundred(value: float | None, digits: int = 1) -> str:
    """A share in percent, without the sign."""
    return "–" if value is None else f"{100 * value:.{digits}f}"


def scaled(value: float | None, by: float) -> str:
    """Three digits in units of `by`."""
    return "–" if value is None else f"{value / by:.3g}"
