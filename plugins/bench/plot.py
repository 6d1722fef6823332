"""Figure of the bench: latency against false alarms."""

from __future__ import annotations

import matplotlib.pyplot as plt
from matplotlib.ticker import FixedLocator, NullLocator

from sliplab.analysis.report.figures.style import (
    PALETTE,
    STYLE,
    WIDTH,
    svg_text,
)
from sliplab.plugins.bench.document import BenchResult

MARKERS = "osD^vPX*"
TICKS_MS = (3, 5, 7, 10, 20, 30, 50, 70, 100, 150, 200, 300, 400, 500, 700, 1000, 2000, 3000, 5000)
_LEAST = 0.5
"""Alarms that a scene without any is drawn at."""


def latency_against_alarms(found: BenchResult) -> str:
    """Return a curve for each detector that detects half of the slips, as SVG.

    Each point is a level that validation scenes set to an asked rate; the rate that test scenes
    showed is drawn. The first point, filled, is the table's. Dotted: see `limit`.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 3.9))
        drawn = 0
        for row in found.detectors:
            points = [
                (max(p.test.false_alarms.alarms, _LEAST) / p.test.false_alarms.hours, late)
                for p in row.curve
                if (late := p.test.latency_ms.value) is not None
            ]
            if not points:
                continue
            colour, marker = PALETTE[drawn % len(PALETTE)], MARKERS[drawn % len(MARKERS)]
            x, y = zip(*points, strict=True)
            style = "-" if drawn < len(PALETTE) else "--"
            axes.plot(x, y, style, color=colour, lw=1, marker=marker, ms=4.5, mfc="white")
            filled = row.table.test.latency_ms.value is not None
            axes.plot(
                x[:1],
                y[:1],
                "",
                color=colour,
                marker=marker,
                ms=6.5,
                mfc=colour if filled else "white",
                label=row.name,
            )
            drawn += 1
        limit = () if found.limit is None else found.limit.points
        known = [
            (point.asked, late) for point in limit if (late := point.latency_ms.value) is not None
        ]
        if known:
            axes.plot(*zip(*known, strict=True), "k:", lw=1.2, label="one marker")
            drawn += 1
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(FixedLocator(TICKS_MS))
        axes.yaxis.set_major_formatter("{x:.0f}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_xlabel("false alarms per hour without slip, on test worlds")
        axes.set_ylabel("median latency from the physical slip (ms)")
        axes.grid(alpha=0.25)
        if drawn:
            axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        return svg_text(figure, found.simulated)
