"""Figures of detectors under nuisances."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import (
    PALETTE,
    STYLE,
    WIDTH,
    name_cells,
    svg_text,
)
from sliplab.plugins.bench.stress.document import StressAccuracy, StressDetector


def clean_trials(
    detectors: Sequence[tuple[str, StressDetector]], names: Sequence[str], *, simulated: bool
) -> str:
    """Draw the share of clean trials of each detector under each nuisance as cells with numbers."""
    share = np.array(
        [
            [
                next(f.clean.value for f in d.figures if (f.nuisance, f.strength) == (name, None))
                for name in names
            ]
            for _, d in detectors
        ]
    )
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(1.35 * WIDTH, 1.2 + 0.32 * len(detectors)))
        axes.imshow(100.0 * share, vmin=0, vmax=100, cmap="YlGnBu", aspect="auto")
        for (row, column), value in np.ndenumerate(share):
            axes.text(
                column,
                row,
                f"{100 * value:.0f}",
                ha="center",
                va="center",
                fontsize=7.5,
                color="white" if value > 0.6 else "black",
            )
        name_cells(axes, [title for title, _ in detectors], names, "", "")
        axes.tick_params(axis="x", labelrotation=45, labelsize=8)
        axes.tick_params(axis="y", labelsize=8)
        return svg_text(figure, simulated)


def by_strength(
    rows: Mapping[str, Sequence[StressAccuracy]], names: Sequence[str], *, simulated: bool
) -> str:
    """Draw strict accuracy over strength, a panel for each nuisance.

    Args:
        rows: of each network.
    """
    columns = 4
    lines = -(-len(names) // columns)
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            lines,
            columns,
            figsize=(1.35 * WIDTH, 1.45 * lines + 0.5),
            sharex=True,
            sharey=True,
            squeeze=False,
        )
        for axes, name in zip(grid.flat, names, strict=False):
            for colour, (network, found) in zip(PALETTE, rows.items(), strict=False):
                ours = [
                    (it.strength, it.strict)
                    for it in found
                    if it.nuisance == name and it.strength is not None and it.strict is not None
                ]
                x = [strength for strength, _ in ours]
                y = 100 * np.array([(s.value, s.low, s.high) for _, s in ours]).reshape(-1, 3)
                axes.plot(x, y[:, 0], "o-", color=colour, ms=3, lw=1.2, label=network)
                axes.fill_between(x, y[:, 1], y[:, 2], color=colour, alpha=0.15, lw=0)
            axes.set_title(name, fontsize=8)
            axes.tick_params(labelbottom=True, labelsize=7.5)
            axes.set_ylim(0, 102)
        for axes in list(grid.flat)[len(names) :]:
            axes.set_axis_off()
        figure.supxlabel("strength (%)", fontsize=9)
        figure.supylabel("strict accuracy (%)", fontsize=9)
        handles, titles = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside upper left", ncols=4, fontsize=8)
        return svg_text(figure, simulated)
