"""One look at a campaign: the event rate of its trials, in the order in which they are taken."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt

from sliplab.analysis.report.figure_style import BLUE, STYLE, svg_text


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
