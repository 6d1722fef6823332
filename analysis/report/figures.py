"""The report's figures, as SVG text: one function a figure, arrays in, a picture out.

Every axis has a unit, colours are told apart by the colour-blind (Okabe and Ito's palette), dense
marks are rasterised inside the SVG, and a simulated figure says so in the picture itself, so that
it still says so when somebody copies it out of the report.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.ticker import MaxNLocator, NullLocator

from sliplab.analysis.report.figure_style import BLUE, GREEN, GREY, ORANGE, RED, STYLE, svg_text

Array = npt.NDArray[Any]

CLASS_COLOURS = (BLUE, ORANGE, RED)
CLASS_WORDS = ("no slip", "incipient slip", "gross slip")


def _name_cells(
    axes: Any,
    rows: Sequence[object],
    columns: Sequence[object],
    row_name: str,
    column_name: str,
) -> None:
    """Names of a table of cells along its left and lower edge."""
    axes.set_xticks(range(len(columns)), [str(item) for item in columns])
    axes.set_yticks(range(len(rows)), [str(item) for item in rows])
    axes.set_xlabel(column_name)
    axes.set_ylabel(row_name)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)


def collected_grid(
    rows: Sequence[object],
    columns: Sequence[object],
    counts: Array,
    planned: Array,
    row_name: str,
    column_name: str,
    *,
    simulated: bool,
) -> str:
    """Collected of planned trials for each pair of levels, counts of shape (rows, columns)."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.2, 0.42 * len(rows) + 1.3))
        share = np.divide(counts, planned, out=np.zeros(counts.shape), where=planned > 0)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1.6, aspect="auto")
        for (i, j), value in np.ndenumerate(counts):
            axes.text(j, i, f"{value} of {planned[i, j]}", ha="center", va="center", fontsize=8)
        _name_cells(axes, rows, columns, row_name, column_name)
        return svg_text(figure, simulated)


def trial_overview(
    frame_s: Array,
    displacement_px: Array,
    event_s: Array,
    event_cell: Array,
    onsets_s: Sequence[float | None],
    motion_s: float,
    threshold_px: float,
    *,
    simulated: bool,
) -> str:
    """Marker displacements, event rate and event raster of one trial over time.

    Args:
        frame_s: (n,) seconds; displacement_px: (n, m), the centre marker first.
        event_s: (k,) seconds of positive events; event_cell: (k,) their cell rows, 0..19.
        onsets_s: incipient and gross onset, seconds; None where there is none.
        motion_s: when the slide or retraction begins.
    """
    with plt.rc_context(STYLE):
        figure, (top, middle, low) = plt.subplots(
            3, 1, figsize=(6.4, 6.2), sharex=True, height_ratios=(3, 1.6, 2.2)
        )
        top.plot(frame_s, displacement_px[:, 1:], color=GREY, lw=0.7, alpha=0.7)
        top.plot([], [], color=GREY, lw=0.7, label="other papillae")
        top.plot(frame_s, displacement_px[:, 0], color=RED, lw=1.6, label="centre papilla")
        top.axhline(threshold_px, color=BLUE, lw=0.8, ls=":", label=f"{threshold_px:g} px")
        top.set_ylabel("marker displacement (px)")
        low_limit = float(np.nanmax(displacement_px)) if np.isfinite(displacement_px).any() else 1.0
        top.set_ylim(-0.03 * low_limit, 1.02 * low_limit)
        span = float(frame_s[-1]) if len(frame_s) else float(event_s.max(initial=1.0))
        edges = np.arange(0.0, span + 0.03, 0.03)
        rate = np.histogram(event_s, edges)[0] / 0.03 / 1000
        middle.step(edges[:-1], rate, where="post", color=BLUE, lw=0.7)
        middle.set_ylabel("positive events\n(thousand/s)")
        middle.set_ylim(bottom=0)
        low.plot(event_s, event_cell, ",", color="black", alpha=0.25, rasterized=True)
        low.set_ylim(19.5, -0.5)
        low.set_ylabel("cell row (of 20)")
        low.set_xlabel("time since the recording began (s)")
        names = ("incipient onset", "gross onset")
        for axes in (top, middle, low):
            axes.axvline(motion_s, color=GREEN, lw=1, ls="--")
            for onset, colour in zip(onsets_s, (ORANGE, RED), strict=True):
                if onset is not None:
                    axes.axvline(onset, color=colour, lw=1.2)
        top.plot([], [], color=GREEN, lw=1, ls="--", label="motion begins")
        for name, colour in zip(names, (ORANGE, RED), strict=True):
            top.plot([], [], color=colour, lw=1.2, label=name)
        handles, titles = top.get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=3, fontsize=8)
        low.set_xlim(0, span)
        return svg_text(figure, simulated)


def confusion(matrix: Array, *, simulated: bool) -> str:
    """Confusion matrix, int (3, 4): the last column holds windows without a unique winner."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(5.2, 3.3))
        total = matrix.sum(axis=1, keepdims=True)
        share = np.divide(matrix, total, out=np.zeros(matrix.shape), where=total > 0)
        axes.imshow(share, cmap="Blues", vmin=0, vmax=1, aspect="auto")
        for (i, j), value in np.ndenumerate(matrix):
            axes.text(
                j,
                i,
                f"{100 * share[i, j]:.1f} %\n{value}",
                ha="center",
                va="center",
                fontsize=8,
                color="white" if share[i, j] > 0.6 else "black",
            )
        said = [*CLASS_WORDS, "undecided"]
        _name_cells(axes, CLASS_WORDS, said, "true class", "class said by the network")
        return svg_text(figure, simulated)


def outputs(
    end_s: Array,
    counts: Array,
    smoothed: Array,
    onsets_s: Sequence[float | None],
    detected_s: Sequence[float | None],
    *,
    simulated: bool,
) -> str:
    """Raw and smoothed output spikes of consecutive windows of one trial, with both onsets.

    Args:
        end_s: (n,) ends of the windows, seconds; counts, smoothed: (n, 3).
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(2, 1, figsize=(6.4, 4.2), sharex=True, sharey=True)
        for panel, values, name in (
            (axes[0], counts, "raw"),
            (axes[1], smoothed, "smoothed"),
        ):
            for index, colour in enumerate(CLASS_COLOURS):
                panel.plot(end_s, values[:, index], color=colour, lw=0.9, label=CLASS_WORDS[index])
            panel.set_ylabel(f"{name} output\n(spikes in a window)")
            for onset, colour in zip(onsets_s, (ORANGE, RED), strict=True):
                if onset is not None:
                    panel.axvline(onset, color=colour, lw=1.4)
            for found, colour in zip(detected_s, (ORANGE, RED), strict=True):
                if found is not None:
                    panel.axvline(found, color=colour, lw=1.2, ls=":")
        axes[0].plot([], [], color="black", lw=1.4, label="true onset")
        axes[0].plot([], [], color="black", lw=1.2, ls=":", label="detected")
        handles, titles = axes[0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=5, fontsize=8)
        axes[1].set_xlabel("time since the recording began (s)")
        axes[1].set_xlim(0, float(end_s[-1]) if len(end_s) else 1.0)
        return svg_text(figure, simulated)


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
        right.plot(
            epochs,
            [row["val_strict"] for row in history],
            color=ORANGE,
            ls=":",
            label="validation, strict",
        )
        right.set_ylabel("accuracy (share)")
        right.set_ylim(right.get_ylim()[0], min(right.get_ylim()[1], 1.0))
        for axes in (left, right):
            axes.axvline(chosen, color=GREY, lw=0.8, ls="--")
            axes.set_xlabel("epoch")
            axes.xaxis.get_major_locator().set_params(integer=True)
            axes.legend(fontsize=8)
        return svg_text(figure, simulated)


def cost_against_error(
    series: Mapping[str, Sequence[tuple[str, float, Mapping[str, float | None]]]],
    errors: Mapping[str, str],
    lines: Mapping[str, Mapping[str, float | None]],
    cost_name: str,
    *,
    simulated: bool,
) -> str:
    """One panel for each kind of error over cost, both logarithmic, two panels a row.

    Args:
        series: by name, at most three: points in order, each with its label, cost and errors by
            key. An error of None is not drawn, one of 0 as a hollow mark below all others.
        errors: key to the name of its axis, one panel each.
        lines: by name, errors by key that are drawn as level lines.
    """
    with plt.rc_context(STYLE):
        rows = -(-len(errors) // 2)
        figure, grid = plt.subplots(
            rows, 2, figsize=(7.6, 2.5 * rows + 0.4), squeeze=False, sharex=True
        )
        for axes in grid.flat[len(errors) :]:
            axes.set_visible(False)
        for axes, (key, name) in zip(grid.flat, errors.items(), strict=False):
            drawn = [value[key] for points in series.values() for _, _, value in points]
            drawn += [value.get(key) for value in lines.values()]
            floor = 0.3 * min((value for value in drawn if value), default=1.0)
            axes.set(xscale="log", yscale="log", ylabel=name)
            axes.margins(0.16)
            for style, (title, points) in zip(_SERIES, series.items(), strict=False):
                _cost_points(axes, points, key, floor, *style, title)
            for (title, value), dashes in zip(lines.items(), ("--", ":", "-."), strict=False):
                axes.axhline(value.get(key) or np.nan, color=GREY, lw=1, ls=dashes, label=title)
            axes.xaxis.set_major_locator(MaxNLocator(5, steps=(1, 2, 5, 10)))
            axes.xaxis.set_major_formatter("{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        for axes in grid[-1]:
            axes.set_xlabel(cost_name)
        handles, titles = grid.flat[0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


_SERIES = (
    (BLUE, "o", (-6, -3), "right"),
    (ORANGE, "s", (0, 6), "center"),
    (GREEN, "^", (0, -11), "center"),
)
"""Colour, mark, and where the label stands."""


def _cost_points(
    axes: Any,
    points: Sequence[tuple[str, float, Mapping[str, float | None]]],
    key: str,
    floor: float,
    colour: str,
    marker: str,
    offset: tuple[int, int],
    side: str,
    title: str,
) -> None:
    """One series of `cost_against_error` in one panel."""
    there = [(text, cost, value[key]) for text, cost, value in points if value[key] is not None]
    heights = [value or floor for _, _, value in there]
    axes.plot([cost for _, cost, _ in there], heights, lw=0.8, color=colour, alpha=0.5)
    for (text, cost, value), height in zip(there, heights, strict=True):
        axes.plot([cost], [height], marker, ms=4.5, mec=colour, mfc=colour if value else "white")
        axes.annotate(
            text, (cost, height), fontsize=7, color=colour, ha=side, xytext=offset,
            textcoords="offset points",
        )  # fmt: skip
    axes.plot([], [], marker, ms=4.5, color=colour, label=title)
