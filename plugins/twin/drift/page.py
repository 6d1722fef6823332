"""The page of a campaign's drift: what its reference trials show of the skin's wear."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.report.page import Figure, Table, render_page
from sliplab.plugins.twin import plot as figures
from sliplab.plugins.twin.drift.document import DriftFit, ParameterDrift

HEADER = ("parameter", "at first", "per 100 trials", "over the campaign", "changed")


def row(it: ParameterDrift) -> list[str]:
    """Return an identified parameter as a row below `HEADER`."""
    start = f"{it.start:,.0f}" if it.start >= 1000.0 else f"{it.start:.3g}"
    return [
        it.title,
        f"{start} {it.unit}".strip(),
        _percent(it.percent_per_100_trials, it.low, it.high),
        _percent(it.change_percent, it.change_low, it.change_high),
        "yes" if it.changed else "no",
    ]


def _percent(middle: float, low: float, high: float) -> str:
    return f"{middle:+.1f} % ({low:+.1f} to {high:+.1f})"


def render(fit: DriftFit) -> str:
    """Return the page as text."""
    known = [it for it in fit.parameters if it.identified]
    panels = [
        figures.Trend(
            it.title,
            [one.place for one in it.references],
            [(one.low, one.factor, one.high) for one in it.references],
            it.percent_per_100_trials,
        )
        for it in known
    ]
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=fit.simulated,
        fit=fit,
        condition=", ".join(f"{name} {value}" for name, value in fit.condition.items()),
        count=len(fit.parameters[0].references),
        figure_of_all=Figure(figures.trends(panels, simulated=fit.simulated)) if panels else None,
        table_of_all=Table(HEADER, [row(it) for it in known]),
        others=[it.title for it in fit.parameters if not it.identified],
    )
