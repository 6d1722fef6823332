"""Figures of trade-offs: cost against error, and single factors of a search."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    STYLE,
    WIDTH,
    svg_text,
)


@dataclass(frozen=True)
class DetectorPoint:
    """A detector.

    Attributes:
        values: its figures by name; None where it has none.
        front: whether it is on the front; paper: whether it is the paper's.
    """

    values: Mapping[str, float | None]
    front: bool
    paper: bool


@dataclass(frozen=True)
class AxisPair:
    """Two figures against each other, by name, and what their axes are called."""

    x: str
    y: str
    x_name: str
    y_name: str
    log_x: bool = False


@dataclass(frozen=True)
class FactorBar:
    """A value of a factor: mean, lowest and highest over seeds of each figure by name."""

    value: str
    paper: bool
    spread: Mapping[str, tuple[float, float, float] | None]


def cost_and_error(
    points: Sequence[DetectorPoint], panels: Sequence[AxisPair], *, simulated: bool
) -> str:
    """Draw errors over costs, a panel for each pair side by side, as SVG.

    Args:
        panels: `AxisPair.x` is a cost; a point without a cost above 0, or without the error, is
            left out.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(1, len(panels), figsize=(WIDTH, 3.2), squeeze=False)
        for axes, panel in zip(grid[0], panels, strict=True):
            drawn = [
                (point, point.values[panel.x], point.values[panel.y])
                for point in points
                if point.values[panel.x] and point.values[panel.y] is not None
            ]
            for on, colour, name in ((False, GREY, "others"), (True, BLUE, "Pareto front")):
                there = [(x, y) for point, x, y in drawn if point.front == on]
                axes.plot(
                    [x for x, _ in there],
                    [y for _, y in there],
                    "o",
                    color=colour,
                    ms=3 + on,
                    mew=0,
                    alpha=0.4 + 0.5 * on,
                    label=name,
                )
            for point, x, y in drawn:
                if point.paper:
                    axes.plot(x, y, "*", color=RED, ms=12, zorder=3)
            axes.plot([], [], "*", color=RED, ms=10, label="paper's settings")
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel(panel.x_name)
            axes.set_ylabel(panel.y_name)
        figure.legend(
            *grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8
        )
        return svg_text(figure, simulated)


def front_panels(
    points: Sequence[DetectorPoint], panels: Sequence[AxisPair], *, simulated: bool
) -> str:
    """A scatter for each panel, two a row: the front above all others, the paper's point marked.

    A point without one of the two figures is not drawn.
    """
    with plt.rc_context(STYLE):
        rows = -(-len(panels) // 2)
        figure, grid = plt.subplots(rows, 2, figsize=(8.4, 2.9 * rows + 0.4), squeeze=False)
        for axes in grid.flat[len(panels) :]:
            axes.set_visible(False)
        for axes, panel in zip(grid.flat, panels, strict=False):
            _points(axes, points, panel)
            axes.set(xlabel=panel.x_name, ylabel=panel.y_name)
            if panel.log_x:
                axes.set_xscale("log")
                axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
                axes.xaxis.set_major_formatter("{x:g}")
                axes.xaxis.set_minor_locator(NullLocator())
            axes.margins(0.06)
        handles, names = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


def _points(axes: Any, points: Sequence[DetectorPoint], panel: AxisPair) -> None:
    kinds = (
        ("another is nowhere worse and somewhere better", False, GREY, "o", 3, 1, 0.5),
        ("on the front", True, BLUE, "o", 4.5, 2, 0.85),
    )
    drawn = [
        (point, point.values[panel.x], point.values[panel.y])
        for point in points
        if point.values[panel.x] is not None and point.values[panel.y] is not None
    ]
    for name, front, colour, mark, size, above, alpha in kinds:
        ours = [(x, y) for point, x, y in drawn if point.front == front]
        axes.plot(
            [x for x, _ in ours],
            [y for _, y in ours],
            mark,
            ms=size,
            mew=0,
            color=colour,
            alpha=alpha,
            zorder=above,
            label=name,
        )
    ours = [(x, y) for point, x, y in drawn if point.paper]
    axes.plot(
        [x for x, _ in ours],
        [y for _, y in ours],
        "*",
        ms=13,
        mec="black",
        mew=0.7,
        color=ORANGE,
        zorder=3,
        label="the paper's",
    )


def factor_lines(
    factors: Mapping[str, Sequence[FactorBar]], figures: Mapping[str, str], *, simulated: bool
) -> str:
    """A column for each factor, a row for each figure: mean over seeds, lowest to highest.

    Args:
        factors: title to values in order.
        figures: name in `FactorBar.spread` to the name of the axis.
    """
    with plt.rc_context(STYLE):
        widths = [max(2, len(bars)) for bars in factors.values()]
        figure, grid = plt.subplots(
            len(figures),
            len(factors),
            figsize=(9.6, 1.9 * len(figures) + 0.5),
            sharey="row",
            squeeze=False,
            width_ratios=widths,
        )
        for row, (key, name) in zip(grid, figures.items(), strict=True):
            row[0].set_ylabel(name)
            for axes, bars in zip(row, factors.values(), strict=True):
                _line(axes, bars, key)
        for axes, title in zip(grid[-1], factors, strict=True):
            axes.set_xlabel(title, fontsize=8)
        return svg_text(figure, simulated)


def _line(axes: Any, bars: Sequence[FactorBar], key: str) -> None:
    there = [(k, bar, bar.spread[key]) for k, bar in enumerate(bars)]
    known = [(k, bar, spread) for k, bar, spread in there if spread is not None]
    axes.plot([k for k, _, _ in known], [s[0] for _, _, s in known], lw=0.8, color=BLUE, alpha=0.5)
    for k, bar, (mean, low, high) in known:
        axes.plot([k, k], [low, high], lw=1.6, color=BLUE)
        colour, mark, size = (ORANGE, "*", 11) if bar.paper else (BLUE, "o", 4)
        edge = "black" if bar.paper else BLUE
        axes.plot([k], [mean], mark, ms=size, color=colour, mec=edge, mew=0.6)
    turned = 40 if any(len(bar.value) > 3 for bar in bars) else 0
    axes.set_xticks(
        range(len(bars)),
        [bar.value for bar in bars],
        fontsize=7,
        rotation=turned,
        ha="right" if turned else "center",
    )
    axes.set_xlim(-0.6, len(bars) - 0.4)
