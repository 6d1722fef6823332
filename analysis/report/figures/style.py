"""Colours and style of all figures, and the SVG text of a picture.

Colours are distinct for the colour-blind (Okabe and Ito's palette), and a simulated figure says so
inside the image, so that a copy of the image is still marked.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy.typing as npt

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.backends.backend_svg import FigureCanvasSVG

BLUE, ORANGE, GREEN, RED, PURPLE, GREY = (
    "#0072B2",
    "#E69F00",
    "#009E73",
    "#D55E00",
    "#CC79A7",
    "#666666",
)
PALETTE = (BLUE, ORANGE, GREEN, RED, PURPLE, GREY)
"""For lines and points of one figure, in this order."""
Array = npt.NDArray[Any]
CLASS_COLOURS = (BLUE, ORANGE, RED)
ONSET_COLOURS = CLASS_COLOURS[1:]
"""Of incipient and gross slip, in labels and, dotted, in detections."""
CLASS_WORDS = ("no slip", "incipient slip", "gross slip")
WIDTH = 6.4
"""Inches: still readable when a telephone shrinks it."""
_DPI = 150
"""Resolution of rasterised parts."""
FIRST_SLIP = "first tip slips (true)"
"""Name of the line that no detection can be below."""
STYLE = {
    "font.size": 9,
    "font.family": "DejaVu Sans",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "svg.hashsalt": "sliplab",
    "svg.fonttype": "none",
    "figure.constrained_layout.use": True,
}


def svg_text(figure: Any, simulated: bool) -> str:
    """Return the picture as SVG text, and close it."""
    if simulated:
        figure.suptitle("simulated", x=0.995, ha="right", fontsize=8, color=GREY, style="italic")
    buffer = io.StringIO()
    figure.set_dpi(_DPI)
    # savefig would give the same, and draw everything twice
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def name_cells(
    axes: Any,
    rows: Sequence[object],
    columns: Sequence[object],
    row_name: str,
    column_name: str,
) -> None:
    """Write the names of a table of cells along its left and lower edge."""
    axes.set_xticks(range(len(columns)), [str(item) for item in columns])
    axes.set_yticks(range(len(rows)), [str(item) for item in rows])
    axes.set_xlabel(column_name)
    axes.set_ylabel(row_name)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
