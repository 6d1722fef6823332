"""Figures of the scene's cost against its error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import MaxNLocator, NullLocator

from sliplab.analysis.report.figures.style import BLUE, GREEN, GREY, ORANGE, STYLE, svg_text


def cost_against_error(
    series: Mapping[str, Sequence[tuple[str, float, Mapping[str, float | None]]]],
    errors: Mapping[str, str],
    lines: Mapping[str, Mapping[str, float | None]],
    cost_name: str,
    *,
    simulated: bool,
) -> str:
    """One panel for each kind of error over cost, both logarithmic, two panels a row.

    Args:
        series: by name, at most three: points in order, each with its label, cost and errors by
            key. An error of None is not drawn, one of 0 as a hollow mark below all others.
        errors: key to the name of its axis, one panel each.
        lines: by name, errors by key that are drawn as level lines.
    """
    with plt.rc_context(STYLE):
        rows = -(-len(errors) // 2)
        figure, grid = plt.subplots(
            rows, 2, figsize=(7.6, 2.5 * rows + 0.4), squeeze=False, sharex=True
        )
        for axes in grid.flat[len(errors) :]:
            axes.set_visible(False)
        for axes, (key, name) in zip(grid.flat, errors.items(), strict=False):
            drawn = [value[key] for points in series.values() for _, _, value in points]
            drawn += [value.get(key) for value in lines.values()]
            floor = 0.3 * min((value for value in drawn if value), default=1.0)
            axes.set(xscale="log", yscale="log", ylabel=name)
            axes.margins(0.16)
            for style, (title, points) in zip(_SERIES, series.items(), strict=False):
                _cost_points(axes, points, key, floor, *style, title)
            for (title, value), dashes in zip(lines.items(), ("--", ":", "-."), strict=False):
                axes.axhline(value.get(key) or np.nan, color=GREY, lw=1, ls=dashes, label=title)
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        for axes in grid[-1]:
            axes.set_xlabel(cost_name)
        handles, titles = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


_SERIES = (
    (BLUE, "o", (-6, -3), "right"),
    (ORANGE, "s", (0, 6), "center"),
    (GREEN, "^", (0, -11), "center"),
)
"""Colour, mark, and offset and alignment of the label."""


def _cost_points(
    axes: Any,
    points: Sequence[tuple[str, float, Mapping[str, float | None]]],
    key: str,
    floor: float,
    colour: str,
    marker: str,
    offset: tuple[int, int],
    side: str,
    title: str,
) -> None:
    """One series of `cost_against_error` in one panel."""
    there = [(text, cost, value[key]) for text, cost, value in points if value[key] is not None]
    heights = [value or floor for _, _, value in there]
    axes.plot([cost for _, cost, _ in there], heights, lw=0.8, color=colour, alpha=0.5)
    for (text, cost, value), height in zip(there, heights, strict=True):
        axes.plot([cost], [height], marker, ms=4.5, mec=colour, mfc=colour if value else "white")
        axes.annotate(
            text,
            (cost, height),
            fontsize=7,
            color=colour,
            ha=side,
            xytext=offset,
            textcoords="offset points",
        )
    axes.plot([], [], marker, ms=4.5, color=colour, label=title)
