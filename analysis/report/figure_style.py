"""What all figures share: colours, style, and how a picture becomes SVG text.

Colours are told apart by the colour-blind (Okabe and Ito's palette), and a simulated figure says so
in the picture itself, so that it still says so when somebody copies it out of its page.
"""

from __future__ import annotations

import io
from typing import Any

import matplotlib

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
WIDTH = 6.4
"""Inches: what still can be read when a telephone shrinks it."""
_DPI = 150
"""Of what is rasterised."""
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
    """The picture as SVG, and the end of it in memory."""
    if simulated:
        figure.suptitle("simulated", x=0.995, ha="right", fontsize=8, color=GREY, style="italic")
    buffer = io.StringIO()
    figure.set_dpi(_DPI)
    # savefig would give the same, and draw everything twice
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]
