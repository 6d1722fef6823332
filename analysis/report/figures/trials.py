"""Figures of single trials: markers and events, outputs over time, and how exact labels are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import NullFormatter

from sliplab.analysis.report.figures.style import (
    BLUE,
    CLASS_COLOURS,
    CLASS_WORDS,
    GREEN,
    GREY,
    ONSET_COLOURS,
    ORANGE,
    RED,
    STYLE,
    WIDTH,
    Array,
    svg_text,
)


def trial_overview(
    frame_s: Array,
    displacement_px: Array,
    event_s: Array,
    event_cell: Array,
    onsets_s: Sequence[float | None],
    motion_s: float | None,
    threshold_px: float,
    cells: int,
    *,
    simulated: bool,
) -> str:
    """Marker displacements, event rate and event raster of one trial over time.

    Args:
        frame_s: (n,) seconds; displacement_px: (n, m), the centre marker first; without markers
            there are only events.
        event_s: (k,) seconds of positive events; event_cell: (k,) their cell rows.
        onsets_s: incipient and gross onset, seconds; None if there is none.
        motion_s: when the slide or retraction begins; None if unknown.
        cells: rows of cells.
    """
    with plt.rc_context(STYLE):
        if displacement_px.shape[1]:
            figure, (top, middle, low) = plt.subplots(
                3, 1, figsize=(6.4, 6.2), sharex=True, height_ratios=(3, 1.6, 2.2)
            )
            _displacements(top, frame_s, displacement_px, threshold_px)
        else:
            figure, (middle, low) = plt.subplots(
                2, 1, figsize=(6.4, 4.2), sharex=True, height_ratios=(1.6, 2.2)
            )
            top = middle
        span = float(frame_s[-1]) if len(frame_s) else float(event_s.max(initial=1.0))
        edges = np.arange(0.0, span + 0.03, 0.03)
        rate = np.histogram(event_s, edges)[0] / 0.03 / 1000
        middle.step(edges[:-1], rate, where="post", color=BLUE, lw=0.7)
        middle.set_ylabel("positive events\n(thousand/s)")
        middle.set_ylim(bottom=0)
        low.plot(event_s, event_cell, ",", color="black", alpha=0.25, rasterized=True)
        low.set_ylim(cells - 0.5, -0.5)
        low.set_ylabel(f"cell row (of {cells})")
        low.set_xlabel("time since the recording began (s)")
        names = ("incipient onset", "gross onset")
        for axes in dict.fromkeys((top, middle, low)):
            if motion_s is not None:
                axes.axvline(motion_s, color=GREEN, lw=1, ls="--")
            for onset, colour in zip(onsets_s, ONSET_COLOURS, strict=True):
                if onset is not None:
                    axes.axvline(onset, color=colour, lw=1.2)
        if motion_s is not None:
            top.plot([], [], color=GREEN, lw=1, ls="--", label="motion begins")
        for name, colour in zip(names, ONSET_COLOURS, strict=True):
            top.plot([], [], color=colour, lw=1.2, label=name)
        handles, titles = top.get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=3, fontsize=8)
        low.set_xlim(0, span)
        return svg_text(figure, simulated)


def _displacements(axes: Axes, frame_s: Array, displacement_px: Array, threshold_px: float) -> None:
    axes.plot(frame_s, displacement_px[:, 1:], color=GREY, lw=0.7, alpha=0.7)
    axes.plot([], [], color=GREY, lw=0.7, label="other papillae")
    axes.plot(frame_s, displacement_px[:, 0], color=RED, lw=1.6, label="centre papilla")
    axes.axhline(threshold_px, color=BLUE, lw=0.8, ls=":", label=f"{threshold_px:g} px")
    axes.set_ylabel("marker displacement (px)")
    most = float(np.nanmax(displacement_px)) if np.isfinite(displacement_px).any() else 1.0
    axes.set_ylim(-0.03 * most, 1.02 * most)


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
            for onset, colour in zip(onsets_s, ONSET_COLOURS, strict=True):
                if onset is not None:
                    panel.axvline(onset, color=colour, lw=1.4)
            for found, colour in zip(detected_s, ONSET_COLOURS, strict=True):
                if found is not None:
                    panel.axvline(found, color=colour, lw=1.2, ls=":")
        axes[0].plot([], [], color="black", lw=1.4, label="labelled onset")
        axes[0].plot([], [], color="black", lw=1.2, ls=":", label="detected")
        handles, titles = axes[0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=5, fontsize=8)
        axes[1].set_xlabel("time since the recording began (s)")
        axes[1].set_xlim(0, float(end_s[-1]) if len(end_s) else 1.0)
        return svg_text(figure, simulated)


def label_uncertainty(
    errors: Mapping[str, Mapping[str, Sequence[float]]],
    widths: Mapping[str, Sequence[float]],
    *,
    simulated: bool,
) -> str:
    """Distances of labels from the truth, and widths of their intervals; cumulated, SVG.

    Args:
        errors: distances in ms by rule and onset; empty where no truth is known.
        widths: of the change points' 95 % intervals in ms, by onset.
    """
    lines = {"incipient": "-", "gross": "--"}
    colours = (BLUE, ORANGE)
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            1, 1 + bool(errors), figsize=(WIDTH, 2.7), sharey=True, squeeze=False
        )
        if errors:
            for (rule, kinds), colour in zip(errors.items(), colours, strict=False):
                for kind, values in kinds.items():
                    _cumulated(grid[0][0], values, f"{rule}, {kind}", colour, lines[kind])
            grid[0][0].set_xlabel("distance from the truth (ms)")
        for kind, values in widths.items():
            _cumulated(grid[0][-1], values, f"change point, {kind}", ORANGE, lines[kind])
        grid[0][-1].set_xlabel("width of its 95 % interval (ms)")
        for axes in grid[0]:
            axes.set_xscale("log")
            axes.xaxis.set_minor_formatter(NullFormatter())  # laying out empty texts takes long
            axes.set_ylim(0, 103)
            axes.axvline(10, color=GREY, lw=0.8, ls=":")
            axes.annotate(
                "a frame", (10, 3), fontsize=7, color=GREY, rotation=90, ha="right", va="bottom"
            )
        grid[0][0].set_ylabel("trials at or below (%)")
        figure.legend(
            *grid[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8
        )
        return svg_text(figure, simulated)


def _cumulated(axes: Any, values: Sequence[float], name: str, colour: str, dashes: str) -> None:
    ordered = sorted(max(value, 1e-3) for value in values)
    shares = [100 * (k + 1) / len(ordered) for k in range(len(ordered))]
    axes.plot(ordered, shares, color=colour, ls=dashes, lw=1.4, label=name, drawstyle="steps-post")
