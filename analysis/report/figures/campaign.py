"""Figures of a campaign: collected trials, and their changes in the order of collection."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    STYLE,
    WIDTH,
    Array,
    name_cells,
    svg_text,
)

DENSE = 250
"""From this many marks on they are drawn as pixels, not as shapes."""


def collected_grid(
    rows: Sequence[object],
    columns: Sequence[object],
    counts: Array,
    planned: Array,
    row_name: str,
    column_name: str,
    *,
    simulated: bool,
) -> str:
    """Collected of planned trials for each pair of levels, counts of shape (rows, columns)."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.2, 0.42 * len(rows) + 1.3))
        share = np.divide(counts, planned, out=np.zeros(counts.shape), where=planned > 0)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1.6, aspect="auto")
        for (i, j), value in np.ndenumerate(counts):
            axes.text(j, i, f"{value} of {planned[i, j]}", ha="center", va="center", fontsize=8)
        name_cells(axes, rows, columns, row_name, column_name)
        return svg_text(figure, simulated)


def event_rates(numbers: Sequence[int], rates: Sequence[float], *, simulated: bool) -> str:
    """Events a second over the trials of a plan, as SVG.

    Args:
        numbers: places in the plan, from 1; rates: events a second, as many.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.0, 2.6))
        axes.plot(numbers, [rate / 1000 for rate in rates], ".", color=BLUE, markersize=3)
        axes.set_ylim(bottom=0)
        axes.set_xlabel("trial, in the plan's order")
        axes.set_ylabel("1000 events/s")
        axes.set_title("Event rate of the committed trials")
        return svg_text(figure, simulated)


def over_campaign(
    numbers: Sequence[int],
    rates: Sequence[float],
    used: Sequence[float],
    again: Mapping[int, int],
    *,
    stream: str = "events",
    simulated: bool,
) -> str:
    """Event rate, the gate that was nearest to its limit, and attempts that failed; SVG.

    Args:
        numbers: places in the plan of the committed trials, from 1.
        rates: events or frames a second of each, as `stream` says.
        used: share of a gate's limit, 0..1, of each.
        again: attempts that are in quarantine, by place in the plan.
    """
    with plt.rc_context(STYLE):
        figure, (top, middle, low) = plt.subplots(
            3, 1, figsize=(WIDTH, 4.0), sharex=True, height_ratios=(2, 2, 1)
        )
        dots: dict[str, Any] = {"ms": 2.5, "mew": 0, "rasterized": len(numbers) >= DENSE}
        unit, of = (1000, "(thousand/s)") if stream == "events" else (1, "(1/s)")
        top.plot(numbers, [rate / unit for rate in rates], "o", color=BLUE, **dots)
        top.set_ylabel(f"{stream}\n{of}")
        top.set_ylim(0, 1.1 * max(rates, default=0.0) / unit or 1.0)  # frames all come at one rate
        middle.plot(numbers, [100 * share for share in used], "o", color=GREEN, **dots)
        middle.axhline(100, color=RED, lw=0.9, ls="--", label="limit")
        middle.set_ylabel("tightest gate\n(% of its limit)")
        middle.set_ylim(0, 110)
        middle.legend(loc="center right", fontsize=8)
        low.bar(list(again), list(again.values()), color=ORANGE, width=max(1, len(numbers) / 200))
        low.set_ylabel("failed\nattempts")
        low.set_ylim(0, max(1, *again.values(), 1) + 0.2)
        low.yaxis.set_major_locator(MaxNLocator(3, integer=True))
        if not again:
            low.annotate("none", (0.5, 0.5), xycoords="axes fraction", color=GREY, ha="center")
        low.set_xlabel("trial, in the plan's order")
        return svg_text(figure, simulated)


def rates_over_motion(
    seconds: Array, curves: Mapping[str, tuple[Array, Array, Array]], *, simulated: bool
) -> str:
    """Event rate against the time from the motion's start, SVG.

    Args:
        seconds: (n,) middles of the intervals.
        curves: by campaign, lower quartile, median and upper quartile over trials, events a second.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.8))
        for colour, (name, (low, middle, high)) in zip(
            (BLUE, ORANGE, GREEN) * len(curves), curves.items(), strict=False
        ):
            axes.fill_between(seconds, low / 1000, high / 1000, color=colour, alpha=0.2, lw=0)
            axes.plot(seconds, middle / 1000, color=colour, label=name)
        axes.axvline(0, color=GREY, lw=0.9, ls="--")
        axes.set_ylim(bottom=0)
        axes.set_xlabel("time from the start of the motion (s)")
        axes.set_ylabel("events\n(thousand/s)")
        axes.legend(loc="upper right", fontsize=8)
        return svg_text(figure, simulated)


def references(
    numbers: Sequence[int],
    panels: Mapping[str, Sequence[float | None]],
    *,
    simulated: bool,
) -> str:
    """Figures of reference trials over the campaign: a panel each, SVG.

    Args:
        numbers: places in the plan, from 1.
        panels: values of the trials by the name of the axis, with its unit.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(panels), 1, figsize=(WIDTH, 1.5 * len(panels) + 0.6), sharex=True, squeeze=False
        )
        for axes, (label, values) in zip(grid[:, 0], panels.items(), strict=True):
            there = [(n, v) for n, v in zip(numbers, values, strict=True) if v is not None]
            axes.plot([n for n, _ in there], [v for _, v in there], "o-", color=BLUE, ms=4, lw=0.7)
            if there:
                axes.axhline(there[0][1], color=GREY, lw=0.8, ls=":")
            axes.set_ylabel(label)
            axes.margins(y=0.3)
        grid[-1][0].set_xlabel("trial, in the plan's order")
        return svg_text(figure, simulated)
