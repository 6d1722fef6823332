"""One look at a search: what each detector costs and how late it is, the best ones marked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
from matplotlib.ticker import MaxNLocator, NullLocator

from sliplab.analysis.report.figure_style import BLUE, GREY, RED, STYLE, WIDTH, svg_text


@dataclass(frozen=True)
class Point:
    """One detector: its cost, its error, whether it is on the front, whether it is the paper's."""

    cost: float
    error: float
    front: bool
    paper: bool


def cost_and_error(panels: Sequence[tuple[str, str, Sequence[Point]]], *, simulated: bool) -> str:
    """A panel for each pair of a cost and an error, side by side, as SVG.

    Args:
        panels: name of the cost's axis, of the error's, and the points; costs above 0.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(1, len(panels), figsize=(WIDTH, 3.2), squeeze=False)
        for axes, (cost, error, points) in zip(grid[0], panels, strict=True):
            for on, colour, name in ((False, GREY, "others"), (True, BLUE, "Pareto front")):
                there = [point for point in points if point.front == on]
                axes.plot(
                    [point.cost for point in there], [point.error for point in there], "o",
                    color=colour, ms=3 + on, mew=0, alpha=0.4 + 0.5 * on, label=name,
                )  # fmt: skip
            for point in points:
                if point.paper:
                    axes.plot(point.cost, point.error, "*", color=RED, ms=12, zorder=3)
            axes.plot([], [], "*", color=RED, ms=10, label="paper's settings")
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(MaxNLocator(4, steps=(1, 2, 5, 10)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
            axes.set_xlabel(cost)
            axes.set_ylabel(error)
        figure.legend(
            *grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8
        )
        return svg_text(figure, simulated)
