"""Figures of windows: training, confusion, recall over a phase, and what a lead means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.report.figures.style import (
    BLUE,
    CLASS_COLOURS,
    CLASS_WORDS,
    GREY,
    ORANGE,
    STYLE,
    Array,
    name_cells,
    svg_text,
)
from sliplab.storage.schema.evaluation import LeadShare, Tenth


def training_curves(history: Sequence[Mapping[str, float]], chosen: int, *, simulated: bool) -> str:
    """Loss and accuracies by epoch, with the chosen epoch."""
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 2.5))
        epochs = [row["epoch"] for row in history]
        left.plot(epochs, [row["loss"] for row in history], color=BLUE, label="training")
        left.plot(epochs, [row["val_loss"] for row in history], color=ORANGE, label="validation")
        left.set_ylabel("cross-entropy (nats)")
        right.plot(epochs, [row["train_argmax"] for row in history], color=BLUE)
        right.plot(epochs, [row["val_argmax"] for row in history], color=ORANGE)
        strict = [row["val_strict"] for row in history]
        right.plot(epochs, strict, color=ORANGE, ls=":", label="validation, strict")
        right.set_ylabel("accuracy (share)")
        right.set_ylim(right.get_ylim()[0], min(right.get_ylim()[1], 1.0))
        for axes in (left, right):
            axes.axvline(chosen, color=GREY, lw=0.8, ls="--")
            axes.set_xlabel("epoch")
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.legend(fontsize=8)
        return svg_text(figure, simulated)


def confusion(matrix: Array, *, simulated: bool) -> str:
    """Confusion matrix, int (3, 4): the last column holds windows without a unique winner."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.2, 3.3))
        total = matrix.sum(axis=1, keepdims=True)
        share = np.divide(matrix, total, out=np.zeros(matrix.shape), where=total > 0)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for (i, j), value in np.ndenumerate(matrix):
            text = f"{100 * share[i, j]:.1f} %\n{value}"
            colour = "white" if share[i, j] > 0.6 else "black"
            axes.text(j, i, text, ha="center", va="center", fontsize=8, color=colour)
        stated = [*CLASS_WORDS, "undecided"]
        name_cells(axes, CLASS_WORDS, stated, "true class", "predicted class")
        return svg_text(figure, simulated)


def recall_by_tenth(tenths: Mapping[str, Sequence[Tenth]], *, simulated: bool) -> str:
    """Recall of each class over its phase, a panel a class.

    Args:
        tenths: ten rows a class.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(1, len(tenths), figsize=(6.4, 2.4), sharey=True)
        for axes, name, word, colour in zip(grid, CLASSES, CLASS_WORDS, CLASS_COLOURS, strict=True):
            for row in tenths[name]:
                if row.share is None:
                    continue
                middle = 10 * row.tenth - 5
                axes.plot(middle, 100 * row.share, "o", ms=4, color=colour)
                if row.low is not None and row.high is not None:
                    axes.plot([middle] * 2, [100 * row.low, 100 * row.high], color=colour)
            axes.set_title(word)
            axes.set_xlim(0, 100)
            axes.set_ylim(-3, 103)
            axes.set_xlabel("of the phase (%)")
        grid[0].set_ylabel("recall (%)")
        return svg_text(figure, simulated)


def reliability(rows: Sequence[LeadShare], *, simulated: bool) -> str:
    """Share right by lead with its interval, and how many windows there are of each.

    Args:
        rows: by lead, in order.
    """
    with plt.rc_context(STYLE):
        figure, (top, low) = plt.subplots(
            2, 1, figsize=(6.2, 3.8), sharex=True, height_ratios=(2.2, 1)
        )
        places = range(len(rows))
        shares = np.array([row.share for row in rows])
        spans = [(row.share, row.share) if row.low is None else (row.low, row.high) for row in rows]
        low_high = np.array(spans, np.float64).reshape(-1, 2)
        off = 100 * np.stack([shares - low_high[:, 0], low_high[:, 1] - shares]).clip(0)
        top.errorbar(places, 100 * shares, off, fmt="o", color=BLUE, ms=4, lw=1, capsize=2)
        top.set_ylabel("windows classified\ncorrectly (%)")
        top.set_ylim(-3, 103)
        low.bar(places, [row.n for row in rows], color=GREY, width=0.7)
        low.set_ylabel("windows")
        low.set_xlabel("lead of the winner over the next class (spikes)")
        low.set_xticks(places, [_from_to(row.lead, row.to) for row in rows], fontsize="x-small")
        return svg_text(figure, simulated)


def _from_to(least: int, most: int | None) -> str:
    if most is None:
        return f"≥ {least}"
    return str(least) if most == least else f"{least}–{most}"
