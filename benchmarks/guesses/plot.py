"""Changes of figures with each parameter, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt

from sliplab.analysis.report.figures.style import BLUE, GREY, ORANGE, STYLE, WIDTH, svg_text


@dataclass(frozen=True)
class FigureChange:
    """Change of a figure at one setting; 0 is unchanged.

    Attributes:
        change: None where the figure cannot be computed.
        span: its interval.
    """

    change: float | None
    span: tuple[float, float] | None


@dataclass(frozen=True)
class ChangePanel:
    """One figure over all rows.

    Attributes:
        label: of the axis, with its unit.
        lower, higher: by row.
        note: what it is unchanged, as text.
    """

    label: str
    lower: Mapping[str, FigureChange]
    higher: Mapping[str, FigureChange]
    note: str


def lowered_and_raised(
    rows: Sequence[str], panels: Sequence[ChangePanel], *, simulated: bool, percent: float
) -> str:
    """Draw panels side by side that share their rows: changes with intervals, as SVG.

    Args:
        rows: names, from top to bottom.
        percent: how much each number was lowered and raised.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            1,
            len(panels),
            figsize=(WIDTH, 0.3 * max(len(rows), 3) + 1.5),
            sharey=True,
            squeeze=False,
        )
        for axes, panel in zip(grid[0], panels, strict=True):
            axes.axvline(0, color=GREY, lw=0.8)
            styles = (
                (panel.lower, -0.16, ORANGE, "v", "less"),
                (panel.higher, 0.16, BLUE, "^", "more"),
            )
            for values, off, colour, marker, word in styles:
                for place, row in enumerate(rows):
                    found = values.get(row)
                    if found is None or found.change is None:
                        continue
                    if found.span is not None:
                        axes.plot(found.span, [place + off] * 2, color=colour, lw=1.1)
                    axes.plot(
                        found.change,
                        place + off,
                        marker,
                        color=colour,
                        ms=4.5,
                        label=f"{percent:.0f} % {word}",
                    )
            axes.set_title(panel.note, fontsize=7.5, color=GREY)
            axes.set_xlabel(panel.label, fontsize=8)
            axes.tick_params(axis="x", labelsize=7.5)
            axes.set_ylim(len(rows) - 0.5, -0.5)
            for place in range(len(rows) - 1):
                axes.axhline(place + 0.5, color=GREY, lw=0.2)
        grid[0][0].set_yticks(range(len(rows)), list(rows), fontsize=8)
        handles = dict(zip(*reversed(grid[0][0].get_legend_handles_labels()), strict=True))
        figure.legend(
            handles.values(), handles.keys(), loc="outside lower center", ncols=2, fontsize=7.5
        )
        return svg_text(figure, simulated)
