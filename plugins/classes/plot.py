"""Figures of recordings of classes: the confusion matrix of many, and accuracy by length."""

from __future__ import annotations

import math
from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import BLUE, GREY, STYLE, WIDTH, Array, svg_text
from sliplab.plugins.classes.document import LengthShare

WRITTEN = 12
"""Classes up to which numbers are written into the cells."""
NAMED = 40
"""Class names along an edge, at most: of more, every second or third is left out."""


def confusion_map(matrix: Array, classes: Sequence[str], *, simulated: bool) -> str:
    """Confusion matrix int (K, K + 1) as a heat map, shares of each row.

    Args:
        matrix: the last column holds windows without a unique winner.
        classes: names of the K classes.
    """
    with plt.rc_context(STYLE):
        many = len(classes)
        side = min(max(3.4, 0.16 * many + 1.2), 6.2)
        figure, axes = plt.subplots(figsize=(WIDTH, side))
        total = matrix.sum(axis=1, keepdims=True)
        share = np.divide(matrix, total, out=np.zeros(matrix.shape), where=total > 0)
        image = axes.imshow(
            100 * share, cmap="Blues", vmin=0, vmax=100, aspect="auto", interpolation="nearest"
        )
        if many <= WRITTEN:
            for (i, j), value in np.ndenumerate(matrix):
                if value:
                    colour = "white" if share[i, j] > 0.6 else "black"
                    axes.text(j, i, f"{value}", ha="center", va="center", fontsize=8, color=colour)
        axes.axvline(many - 0.5, color=GREY, lw=0.6)
        every = math.ceil(many / NAMED)
        small = 8 if many <= WRITTEN else 6.5
        places = list(range(0, many, every))
        named = [_short(classes[k]) for k in places]
        axes.set_yticks(places, named, fontsize=small)
        turned = max(map(len, named)) > 2 or many > WRITTEN
        axes.set_xticks(
            [*places, many],
            [*named, "undecided"],
            fontsize=small,
            rotation=90 if turned else 0,
        )
        axes.tick_params(length=0)
        axes.spines[:].set_visible(False)
        axes.set_xlabel("predicted class")
        axes.set_ylabel("true class")
        bar = figure.colorbar(image, ax=axes, pad=0.02, fraction=0.04)
        bar.set_label("of the true class (%)")
        bar.outline.set_visible(False)
        return svg_text(figure, simulated)


def _short(name: str) -> str:
    return name if len(name) <= 18 else f"{name[:17]}…"


def accuracy_by_length(rows: Sequence[LengthShare], chance: float, *, simulated: bool) -> str:
    """Accuracy by the length of the window that is seen, with its interval."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.8))
        ms = [row.ms for row in rows]
        shares = [math.nan if row.share is None else 100 * row.share for row in rows]
        known = [row for row in rows if row.low is not None and row.high is not None]
        axes.fill_between(
            [row.ms for row in known],
            [100 * (row.low or 0.0) for row in known],
            [100 * (row.high or 0.0) for row in known],
            color=BLUE,
            alpha=0.18,
            lw=0,
        )
        axes.plot(ms, shares, "o-", color=BLUE, ms=4, lw=1.4)
        axes.axhline(100 * chance, color=GREY, lw=0.9, ls="--")
        axes.set_xlim(0, 1.02 * ms[-1])
        axes.set_ylim(0, 103)
        axes.set_xlabel("seen of each window (ms)")
        axes.set_ylabel("accuracy, argmax (%)")
        return svg_text(figure, simulated)
