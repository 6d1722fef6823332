"""Intervals of claims against trials taken."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import BLUE, GREEN, GREY, RED, STYLE, WIDTH, svg_text
from sliplab.plugins.claims.document import Look


def looks(found: Sequence[Look], *, simulated: bool) -> str:
    """Draw the estimate and the interval of each claim at each look, as SVG.

    An interval without an end has none drawn. The value that is claimed is a line; a filled dot is
    a look at which the claim was settled.
    """
    taken = np.array([look.taken for look in found])
    count = len(found[0].claims)
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            count, 1, figsize=(WIDTH, 1.7 * count + 0.4), sharex=True, squeeze=False
        )
        for k, axes in enumerate(grid[:, 0]):
            states = [look.claims[k] for look in found]
            table = np.array([[s.estimate, s.low, s.high] for s in states], np.float64)
            middle, low, high = table.T
            axes.fill_between(taken, low, high, color=BLUE, alpha=0.2, lw=0)
            for end in (low, high):
                axes.plot(taken, end, color=BLUE, lw=0.8, marker=".", ms=3)
            colours = [GREEN if s.holds else RED if s.refuted else "white" for s in states]
            axes.plot(taken, middle, color=BLUE, lw=1)
            axes.scatter(taken, middle, c=colours, edgecolors=BLUE, s=18, zorder=3)
            value = states[0].value
            claimed = {"within": [], "apart": [-value, value]}.get(states[0].kind, [value])
            for line in claimed:
                axes.axhline(line, color=GREY, ls="--", lw=1)
            axes.set_ylabel(states[0].unit)
            axes.set_title("\n".join(textwrap.wrap(states[0].claim, 90)), fontsize=8, loc="left")
        grid[-1, 0].set_xlabel("trials taken")
        grid[-1, 0].set_xlim(0, None)
        return svg_text(figure, simulated)
