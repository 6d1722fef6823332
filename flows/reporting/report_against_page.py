"""The page of two reports compared, `report/against.html`, and the same as a table in text."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sliplab.analysis.report.figures.intervals import differences
from sliplab.analysis.report.page import Figure, Number, Section, Table, render_page
from sliplab.flows.reporting.report_against import BASES

Json = dict[str, Any]

PAGE = "against.html"
COLUMNS = (
    "figure",
    "here",
    "there",
    "difference",
    "95 % by chance",
    "more than noise?",
    "judged by",
)
TERMINAL = ("figure", "here", "there", "difference", "more than noise?")
_PANELS = {"ms": ("Times", 1.0, "difference, here less there (ms)"),
           "share": ("Shares", 100.0, "difference, here less there (points)")}  # fmt: skip


def render(compared: Json, here: Path, there: Path) -> str:
    """The page as text; everything in it is escaped but the figures' SVG."""
    simulated = compared["simulated"]
    any_simulated = bool(simulated["here"] or simulated["there"])
    both = simulated["here"] == simulated["there"]
    which = "Both reports are" if both else f"The one {'here' if simulated['here'] else 'there'} is"
    return render_page(
        "against.html",
        [_figures(compared["figures"], any_simulated), _settings(compared["settings"])],
        simulated=any_simulated,
        simulated_words=f"{which} simulated.",
        here=str(here.resolve()),
        there=str(there.resolve()),
        headline=_headline(compared),
    )


def short_table(figures: Sequence[Json]) -> tuple[list[str], list[list[str]]]:
    """Columns and rows that fit a terminal."""
    kept = [COLUMNS.index(name) for name in TERMINAL]
    return [COLUMNS[k] for k in kept], [[row[k] for k in kept] for row in table(figures)]


def table(figures: Sequence[Json]) -> list[list[str]]:
    """Rows of text under `COLUMNS`."""
    return [
        [
            row["name"],
            _value(row["here"], row["unit"]),
            _value(row["there"], row["unit"]),
            _gap(row["difference"], row["unit"]),
            "–"
            if row["low"] is None
            else f"{_gap(row['low'], row['unit'])} to {_gap(row['high'], row['unit'])}",
            _verdict(row),
            BASES[row["basis"]],
        ]
        for row in figures
    ]


def _headline(compared: Json) -> list[Number]:
    figures = compared["figures"]
    judged = [row for row in figures if row["basis"] != "none"]
    beyond = sum(bool(row["beyond"]) for row in judged)
    return [
        Number("figures", str(len(figures)), f"{len(judged)} with noise that is known"),
        Number(
            "more than noise", str(beyond), f"{len(judged) / 20:.0f} of {len(judged)} by chance"
        ),
        Number("settings", str(len(compared["settings"])), "differ"),
    ]


def _figures(figures: Sequence[Json], simulated: bool) -> Section:
    pictures = []
    for unit, (title, factor, label) in _PANELS.items():
        rows = [
            (row["name"], *(factor * row[key] for key in ("difference", "low", "high")))
            for row in figures
            if row["unit"] == unit and row["low"] is not None
        ]
        if rows:
            pictures.append(
                Figure(
                    differences(rows, label, simulated=simulated),
                    f"{title}: each difference with what chance does to it, 95 %. Orange diamonds: "
                    "the interval does not reach zero, so the difference is more than noise.",
                )
            )
    return Section(
        "What changed",
        [
            "Seed noise is judged by the spread between trained seeds where at least one report "
            "has several. Elsewhere by the spread between trials, which tells whether these two "
            "networks differ on such trials; it does not tell what another seed of either would "
            "have done. One in twenty differences is called more than noise by chance alone.",
        ],
        pictures,
        [Table(COLUMNS, table(figures), "Shares in percent, their differences in points.")],
    )


def _settings(rows: Sequence[Json]) -> Section:
    if not rows:
        return Section("What made them", ["Protocols, settings, seeds and versions are the same."])
    cells = [[row["what"], _short(row["here"]), _short(row["there"])] for row in rows]
    return Section(
        "What made them",
        ["Only what differs of protocols (hashes), detection settings, seeds and versions."],
        tables=[Table(("what", "here", "there"), cells)],
    )


def _short(value: object) -> str:
    text = "–" if value is None else str(value)
    return text if len(text) <= 24 else f"{text[:16]}…"


def _value(value: float, unit: str) -> str:
    if unit == "share":
        return f"{100 * value:.1f} %"
    return f"{value:,.0f}" if not unit else f"{value:.1f} {unit}"


def _gap(value: float, unit: str) -> str:
    if unit == "share":
        return f"{100 * value:+.1f}"
    return f"{value:+,.0f}" if not unit else f"{value:+.1f}"


def _verdict(row: Json) -> str:
    if row["beyond"] is None:
        return "not known"
    return "yes" if row["beyond"] else "no"
