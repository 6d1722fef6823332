"""Figures of detectors: latency against the rate of false early detections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt

from sliplab.analysis.report.figures.style import (
    BLUE,
    FIRST_SLIP,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    STYLE,
    svg_text,
)

_LINES = (
    (GREY, "-", "o"),
    ("black", "-", "s"),
    (BLUE, "-", "o"),
    (ORANGE, "-", "o"),
    (GREEN, "-", "o"),
    (BLUE, ":", "^"),
    (ORANGE, ":", "^"),
    (GREEN, ":", "^"),
    (PURPLE, "-", "o"),
    (RED, "-", "o"),
)


Curve = Sequence[tuple[float, float | None]]


def latency_over_rate(
    panels: Mapping[str, Mapping[str, Curve]], first_slip_ms: float | None, *, simulated: bool
) -> str:
    """A panel for each stride, a line for each detector, as SVG.

    Args:
        panels: title to name to points: false early rate 0..1 and median latency in ms, None
            where more than half of the onsets were missed.
        first_slip_ms: when the first tip slips, median, from the onset; None where not known.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(1, len(panels), figsize=(6.4, 4.0), sharey=True, squeeze=False)
        curves = [points for lines in panels.values() for points in lines.values()]
        most = max(1.0, *(100 * rate for points in curves for rate, _ in points))
        for axes, (title, lines) in zip(grid[0], panels.items(), strict=True):
            for number, (name, points) in enumerate(lines.items()):
                colour, dashes, mark = _LINES[number % len(_LINES)]
                there = [(100 * rate, late) for rate, late in points if late is not None]
                axes.plot(
                    [rate for rate, _ in there],
                    [late for _, late in there],
                    mark,
                    ls=dashes,
                    ms=3.5,
                    lw=1,
                    color=colour,
                    label=name,
                )
            axes.set_title(title)
            axes.set_xlabel("false early, validation trials (%)")
            if first_slip_ms is None:
                axes.set_ylim(bottom=0)
            else:
                axes.axhline(first_slip_ms, color=GREY, lw=1.0, ls=":", label=FIRST_SLIP)
            axes.set_xlim(-0.05 * most, 1.05 * most)
        grid[0][0].set_ylabel("median incipient latency,\ntest trials (ms)")
        handles, names = grid[0][0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=2, fontsize=8)
        return svg_text(figure, simulated)
