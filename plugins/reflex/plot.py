"""Figures of a study of reflexes: plates held, distances fallen, reaction times, time courses."""

from __future__ import annotations

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    RED,
    STYLE,
    WIDTH,
    svg_text,
)
from sliplab.plugins.reflex.document import ReflexRow, ReflexTrial, title_of

PART_COLOURS = {
    "window": BLUE,
    "sensor": ORANGE,
    "network": GREEN,
    "command": PURPLE,
    "actuator": RED,
}


def outcomes(rows: Sequence[ReflexRow], trials: Sequence[ReflexTrial], *, simulated: bool) -> str:
    """Draw the plates that were held, of every condition, by row; red: all dropped."""
    conditions = sorted({(it.speed_mm_s, it.mass_kg) for it in trials})
    held = np.full((len(rows), len(conditions)), np.nan)
    text = [["" for _ in conditions] for _ in rows]
    for i, row in enumerate(rows):
        for k, condition in enumerate(conditions):
            found = [
                it
                for it in trials
                if (it.detector, it.reflex) == (row.detector, row.reflex)
                and (it.speed_mm_s, it.mass_kg) == condition
            ]
            count = sum(not it.dropped for it in found)
            held[i, k] = count / len(found) if found else np.nan
            text[i][k] = f"{count}/{len(found)}"
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(1.35 * WIDTH, 0.9 + 0.32 * len(rows)))
        axes.imshow(held, cmap="RdYlGn", vmin=-0.1, vmax=1.1, aspect="auto")
        for i, line in enumerate(text):
            for k, cell in enumerate(line):
                axes.text(k, i, cell, ha="center", va="center", fontsize=8)
        names = [f"{1e3 * mass:.0f}\n{speed:g}" for speed, mass in conditions]
        axes.set_xticks(range(len(conditions)), names, fontsize=7.5)
        axes.set_xlabel("mass of the plate (g), speed of the retraction (mm/s)")
        axes.set_yticks(range(len(rows)), [title_of(row) for row in rows])
        axes.spines[:].set_visible(False)
        axes.tick_params(length=0)
        axes.set_title("plates held / trials")
        return svg_text(figure, simulated)


def reactions(rows: Sequence[ReflexRow], *, simulated: bool) -> str:
    """Draw the median parts of the reaction time, from the first tip's slip on, as bars."""
    shown = [row for row in rows if row.reaction is not None]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 1.1 + 0.3 * len(shown)))
        for i, row in enumerate(shown):
            left = 0.0
            for part, colour in PART_COLOURS.items():
                value = getattr(row.reaction, part)
                axes.barh(i, value, left=left, color=colour, label=part if i == 0 else None)
                left += value
        axes.set_yticks(range(len(shown)), [title_of(row) for row in shown])
        axes.set_ylim(len(shown) - 0.5, -0.5)
        axes.set_xlabel("ms after the first tip slipped (medians of the parts)")
        figure.legend(loc="outside lower center", ncols=len(PART_COLOURS), fontsize=8)
        return svg_text(figure, simulated)


def fallen(rows: Sequence[ReflexRow], trials: Sequence[ReflexTrial], *, simulated: bool) -> str:
    """Draw the distance that every plate fell before the sensor left."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 1.0 + 0.3 * len(rows)))
        for i, row in enumerate(rows):
            found = [it for it in trials if (it.detector, it.reflex) == (row.detector, row.reflex)]
            ways = np.array([max(it.fallen_mm, 1e-3) for it in found])
            at = i + np.linspace(-0.25, 0.25, len(ways)) if len(ways) > 1 else np.array([i])
            colour = [RED if it.dropped else GREEN for it in found]
            axes.scatter(ways, at, c=colour, s=10, alpha=0.7, linewidths=0)
        axes.set_xscale("log")
        axes.set_yticks(range(len(rows)), [title_of(row) for row in rows])
        axes.invert_yaxis()
        axes.set_xlabel("way fallen (mm); green: held, red: dropped")
        return svg_text(figure, simulated)


def courses(trials: Sequence[ReflexTrial], *, simulated: bool) -> str:
    """Draw the plates of one condition over time, without and with reflexes."""
    colours = (GREY, BLUE, ORANGE, GREEN, PURPLE, RED)
    with plt.rc_context(STYLE):
        rows = -(-len(trials) // 2)
        figure, axes = plt.subplots(figsize=(WIDTH, 2.4 + 0.17 * rows))
        for k, it in enumerate(trials):
            t_s = np.arange(len(it.heights_mm)) * it.step_ms / 1e3
            axes.plot(
                t_s,
                it.heights_mm,
                color=colours[k % len(colours)],
                label=title_of(it),
                lw=1.4,
                ls="-" if k < len(colours) else "--",
            )
            if it.detected_ms is not None:
                axes.axvline(it.detected_ms / 1e3, color=colours[k % len(colours)], lw=0.6, ls=":")
        axes.set_xlabel("s after the retraction began; dotted: slip detected")
        axes.set_ylabel("plate (mm)")
        figure.legend(loc="outside lower center", ncols=2, fontsize=7.5)
        return svg_text(figure, simulated)
