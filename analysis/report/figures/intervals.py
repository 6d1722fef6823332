"""Figures of values with intervals, a row each: by condition, shares, differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.metrics.intervals import interval
from sliplab.analysis.report.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    STYLE,
    WIDTH,
    svg_text,
)


@dataclass(frozen=True)
class Panel:
    """One quantity over all rows.

    Attributes:
        label: of the axis, with its unit.
        values: by row, one a trial; a row without an entry stays empty.
        colour: of its dots.
        zero: the meaning of zero, as text; empty where zero has none.
        least: the smallest value that there can be.
        limit: a value that none can be below, as it is known of the scene, and its meaning.
        notes: by row, what to write at its right end, such as how many have no value.
    """

    label: str
    values: Mapping[str, Sequence[float]]
    colour: str = BLUE
    zero: str = ""
    notes: Mapping[str, str] = field(default_factory=dict)
    least: float = -np.inf
    limit: tuple[float, str] | None = None


def by_condition(
    rows: Sequence[str], panels: Sequence[Panel], *, simulated: bool, breaks: Sequence[int] = ()
) -> str:
    """Draw panels side by side that share their rows, as SVG.

    Args:
        rows: names, from top to bottom.
        breaks: rows that begin a new group; a thin line is drawn above each.
    """
    height = 0.26 * max(len(rows), 3) + 1.25
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            1, len(panels), figsize=(WIDTH, height), sharey=True, squeeze=False
        )
        rng = np.random.default_rng(0)
        for axes, panel in zip(grid[0], panels, strict=True):
            room = _room(panel)
            for place, row in enumerate(rows):
                there = np.asarray(panel.values.get(row, ()), np.float64)
                spread = rng.uniform(-0.2, 0.2, len(there))
                axes.plot(there, place + spread, "o", ms=2.6, color=panel.colour, alpha=0.6, mew=0)
                if len(there):
                    span = interval(there, least=panel.least) or (np.nan, np.nan)
                    bar = np.clip(span, *room)
                    axes.plot(bar, [place, place], color="black", lw=1.6)
                    for end, drawn, arrow in zip(span, bar, "<>", strict=True):
                        if abs(end - drawn) > 0:  # of no interval both are NaN
                            axes.plot(drawn, place, arrow, color="black", ms=4, clip_on=False)
                    axes.plot(there.mean(), place, "D", color="black", ms=3.8)
                note = panel.notes.get(row, "" if len(there) else "none")
                if note:
                    axes.annotate(
                        note,
                        (1, place),
                        xycoords=("axes fraction", "data"),
                        fontsize=7,
                        color=GREY,
                        va="center",
                        ha="left",
                        xytext=(2, 0),
                        textcoords="offset points",
                    )
            for place in breaks:
                axes.axhline(place - 0.5, color=GREY, lw=0.4)
            lines = []
            if panel.zero:
                axes.axvline(0, color=GREY, lw=0.8)
                lines.append(f"0: {panel.zero}")
            if panel.limit is not None:
                axes.axvline(panel.limit[0], color=GREY, lw=1.0, ls=":")
                lines.append(f"dotted: {panel.limit[1]}")
            axes.set_title("\n".join(lines), fontsize=7.5, color=GREY)
            axes.set_xlabel(panel.label)
            axes.set_ylim(len(rows) - 0.5, -0.5)
            axes.set_xlim(*room)
            if not any(len(panel.values.get(row, ())) for row in rows):
                axes.set_xticks([])  # no scale is read where nothing is drawn
                axes.annotate(
                    "none",
                    (0.5, 0.5),
                    xycoords="axes fraction",
                    fontsize=8,
                    color=GREY,
                    ha="center",
                    va="center",
                    backgroundcolor="white",
                )
        grid[0][0].set_yticks(range(len(rows)), list(rows))
        return svg_text(figure, simulated)


def _room(panel: Panel) -> tuple[float, float]:
    """Limits of a panel: all trials; the wide interval of a few is cut off, with an arrow."""
    shown = [value for values in panel.values.values() for value in values]
    shown += [0.0] if panel.zero else []
    shown += [] if panel.limit is None else [panel.limit[0]]
    low, high = min(shown, default=0.0), max(shown, default=1.0)
    margin = 0.06 * (high - low) or 1.0
    return low - margin, high + margin


@dataclass(frozen=True)
class ShareInterval:
    """A share with its interval: 0..1, None where it is not known."""

    name: str
    value: float | None
    low: float | None
    high: float | None


def shares(
    groups: Mapping[str, Sequence[ShareInterval]],
    label: str,
    *,
    simulated: bool,
    line: tuple[float, str] | None = None,
) -> str:
    """Shares in percent with intervals, a row each, groups under each other, as SVG.

    Args:
        groups: by title; titles are written above their rows.
        line: a share that all are compared with, and how it is called.
    """
    with plt.rc_context(STYLE):
        count = sum(len(found) + 1 for found in groups.values())
        figure, axes = plt.subplots(figsize=(WIDTH, 0.19 * count + 1.0))
        names: list[str] = []
        places: list[int] = []
        place = 0
        for title, found in groups.items():
            axes.annotate(
                title,
                (0, place),
                xycoords=("axes fraction", "data"),
                fontsize=8,
                weight="bold",
                va="center",
                xytext=(3, 0),
                textcoords="offset points",
            )
            for item in found:
                place += 1
                names.append(item.name)
                places.append(place)
                if item.value is None:
                    continue
                if item.low is not None and item.high is not None:
                    axes.plot([100 * item.low, 100 * item.high], [place] * 2, color=BLUE, lw=1.4)
                axes.plot(100 * item.value, place, "o", color=BLUE, ms=4)
            place += 1
        if line is not None:
            axes.axvline(100 * line[0], color=GREY, lw=0.9, ls="--", label=line[1])
            axes.legend(
                loc="upper right",
                fontsize=7.5,
                bbox_to_anchor=(1, 1.0),
                frameon=True,
                framealpha=1.0,
                edgecolor="none",
            )
        axes.set_yticks(places, names, fontsize=8)
        axes.set_ylim(place - 0.3, -0.7)
        axes.set_xlabel(label)
        return svg_text(figure, simulated)


def differences(
    rows: Sequence[tuple[str, float, float, float]], label: str, *, simulated: bool
) -> str:
    """Differences with intervals, a row each, around a line at zero, as SVG.

    Args:
        rows: name, difference, low and high.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 0.26 * len(rows) + 0.9))
        for place, (_, value, low, high) in enumerate(rows):
            off = not low <= 0 <= high
            colour = ORANGE if off else BLUE
            axes.plot([low, high], [place] * 2, color=colour, lw=1.6)
            axes.plot(value, place, "D" if off else "o", color=colour, ms=4.5)
        axes.axvline(0, color=GREY, lw=0.8)
        axes.set_yticks(range(len(rows)), [row[0] for row in rows], fontsize=8)
        axes.set_ylim(len(rows) - 0.4, -0.6)
        axes.set_xlabel(label)
        return svg_text(figure, simulated)
