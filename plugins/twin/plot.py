"""Figures of a twin: its intervals, and a pilot's test trials next to simulated ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREY,
    ORANGE,
    RED,
    STYLE,
    Array,
    svg_text,
)
from sliplab.plugins.twin.document import ParameterFit
from sliplab.plugins.twin.shown import Course, SameTrials, SlideCurves

PANELS = 3
"""Test trials that are drawn over time."""


def intervals(parameters: Sequence[ParameterFit], *, simulated: bool) -> str:
    """Draw each parameter's 95 % interval as factors of what the rig file assumed."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(6.4, 0.6 + 0.2 * len(parameters)))
        titles = []
        for row, it in enumerate(parameters):
            least, middle, most = (x / it.assumed for x in (it.least, it.value, it.most))
            axes.plot([least, most], [row, row], color="#dddddd", lw=6, solid_capstyle="butt")
            if it.low is None or it.high is None:
                titles.append(f"{it.title} (withheld)")
                continue
            titles.append(it.title)
            colour = BLUE if it.identified else GREY
            axes.plot([it.low / it.assumed, it.high / it.assumed], [row, row], color=colour, lw=2)
            axes.plot(middle, row, "o", color=colour, ms=4)
        axes.axvline(1.0, color="black", lw=0.8)
        axes.set_yticks(range(len(titles)), titles)
        axes.set_ylim(len(titles) - 0.5, -0.5)
        axes.set_xscale("log")
        ticks = [0.5, 0.7, 1.0, 1.4, 2.0]
        axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        axes.minorticks_off()
        axes.set_xlabel("value over the rig file's")
        axes.plot([], [], color=BLUE, lw=2, label="identified, 95 %")
        axes.plot([], [], color=GREY, lw=2, label="not identified")
        axes.plot([], [], color="#dddddd", lw=6, label="simulated worlds")
        figure.legend(loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


def of_trials(trials: SameTrials, *, simulated: bool) -> Iterator[tuple[str, str]]:
    """Yield figures of the test trials, each with its caption; none without any."""
    if not trials.pilot:
        return
    events = all(it.map is not None for it in trials.pilot)
    if events:
        rates = _curves(trials, lambda it: it.rate)
        yield (
            over_time(rates, "positive events/s", simulated=simulated),
            "Positive events per second, in bins of 0.1 s.",
        )
    moved = _curves(trials, lambda it: it.moved)
    yield (
        over_time(moved, "moved (mm)", simulated=simulated),
        "Mean displacement of the markers along the slide.",
    )
    of_pilot = np.stack([it.slips_s for it in trials.pilot])
    twin, before = (
        np.nanmedian([[it.slips_s for it in world] for world in worlds], axis=0)
        for worlds in (trials.twin, trials.before)
    )
    yield (
        slip_order(of_pilot, twin, before, trials.rings, simulated=simulated),
        "Time of each marker's slip in each test trial, since the slide began: median of the "
        "worlds, over the pilot's.",
    )
    if events:
        means = (
            np.mean([it.map for world in worlds for it in world if it.map is not None], axis=0)
            for worlds in ([trials.pilot], trials.twin, trials.before)
        )
        yield (
            maps(*means, simulated=simulated),
            "Positive events of the slides in the middle of the event camera's picture.",
        )


@dataclass(frozen=True)
class Curves:
    """One quantity of one trial over time.

    Attributes:
        title: of the trial. t_s: (n,). pilot: (n,). twin, before: of several worlds, (k, n).
    """

    title: str
    t_s: Array
    pilot: Array
    twin: Array
    before: Array


def _curves(trials: SameTrials, of: Callable[[SlideCurves], Course | None]) -> list[Curves]:
    """Return a course of the first trials, the worlds' at the times of the pilot's."""
    found = []
    for k, trial in enumerate(trials.pilot[:PANELS]):
        own = of(trial)
        theirs = [[of(world[k]) for world in worlds] for worlds in (trials.twin, trials.before)]
        if own is not None:
            aligned = (
                np.stack([np.interp(own[0], *course) for course in courses if course is not None])
                for courses in theirs
            )
            found.append(Curves(trial.trial, *own, *aligned))
    return found


def over_time(panels: Sequence[Curves], label: str, *, simulated: bool) -> str:
    """Draw a quantity of some trials over time: the pilot's on the middle 95 % of the worlds'."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(
            len(panels), 1, figsize=(6.4, 1.6 * len(panels) + 0.5), squeeze=False
        )
        for ax, it in zip(axes[:, 0], panels, strict=True):
            for worlds, colour, name in (
                (it.before, ORANGE, "rig file as it was"),
                (it.twin, BLUE, "twin"),
            ):
                low, middle, high = np.nanquantile(worlds, (0.025, 0.5, 0.975), axis=0)
                ax.fill_between(it.t_s, low, high, color=colour, alpha=0.25, lw=0)
                ax.plot(it.t_s, middle, color=colour, lw=1, label=f"{name}, middle 95 %")
            ax.plot(it.t_s, it.pilot, color="black", lw=1, label="pilot")
            ax.set_title(it.title)
            ax.set_ylabel(label)
            ax.set_ylim(bottom=0.0)
        axes[-1, 0].set_xlabel("time since the slide began (s)")
        handles, titles = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


def slip_order(
    pilot_s: Array, twin_s: Array, before_s: Array, rings: Array, *, simulated: bool
) -> str:
    """Draw when each marker of each trial slipped: simulated against the pilot.

    Args:
        pilot_s, twin_s, before_s: seconds after the start, (trials, m); medians of the worlds.
        rings: layer of each marker, (m,).
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(6.4, 3.1), sharex=True, sharey=True)
        most = float(np.nanmax([np.nanmax(pilot_s), np.nanmax(twin_s), np.nanmax(before_s)]))
        for ax, found, name in (
            (axes[0], before_s, "rig file as it was"),
            (axes[1], twin_s, "twin"),
        ):
            ax.plot([0, most], [0, most], color="black", lw=0.8)
            for ring, colour in zip(np.unique(rings), (RED, ORANGE, BLUE, GREY) * 15, strict=False):
                of = rings == ring
                title = "centre" if ring == 0 else f"ring {ring:.0f}"
                ax.plot(
                    pilot_s[:, of].ravel(),
                    found[:, of].ravel(),
                    ".",
                    color=colour,
                    ms=4,
                    label=title,
                )
            ax.set_title(name)
            ax.set_xlabel("time of a marker's slip, pilot (s)")
        axes[0].set_ylabel("the same, simulated (s)")
        handles, titles = axes[0].get_legend_handles_labels()
        figure.legend(handles, titles, loc="outside lower center", ncols=4, fontsize=8)
        return svg_text(figure, simulated)


def maps(pilot: Array, twin: Array, before: Array, *, simulated: bool) -> str:
    """Draw positive events of the test trials' slides over the centre crop, events per cell.

    Args:
        pilot, twin, before: means over trials and worlds, (rows, columns).
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(1, 3, figsize=(6.4, 2.5))
        most = max(float(found.max()) for found in (pilot, twin, before))
        for ax, found, name in zip(
            axes, (pilot, twin, before), ("pilot", "twin", "rig file as it was"), strict=True
        ):
            image = ax.imshow(found, cmap="viridis", vmin=0.0, vmax=most)
            ax.set_title(name)
            ax.set_xticks([])
            ax.set_yticks([])
        figure.colorbar(image, ax=axes, shrink=0.8, label="events per cell and trial")
        return svg_text(figure, simulated)


@dataclass(frozen=True)
class ParameterTrend:
    """A parameter along a campaign.

    Attributes:
        places: of the references in the plan. factors: low, middle and high of each, over the
            line's first value. percent: the line's slope per 100 trials.
    """

    title: str
    places: Sequence[int]
    factors: Sequence[tuple[float, float, float]]
    percent: float


def trends(panels: Sequence[ParameterTrend], *, simulated: bool) -> str:
    """Draw parameters over the campaign, each over its value at the first reference."""
    with plt.rc_context(STYLE):
        rows = (len(panels) + 1) // 2
        figure, axes = plt.subplots(
            rows, 2, figsize=(6.4, 1.5 * rows + 0.3), sharex=True, squeeze=False
        )
        for ax, it in zip(axes.ravel(), panels, strict=False):
            low, middle, high = np.array(it.factors).T
            ax.errorbar(
                it.places, middle, (middle - low, high - middle), fmt="o", color=BLUE, ms=3, lw=1
            )
            along = np.linspace(it.places[0], it.places[-1], 50)
            ax.plot(along, (1.0 + it.percent / 100.0) ** ((along - along[0]) / 100.0), color=RED)
            # a parameter that is known to a thousandth does not move
            least, most = min(low.min(), 0.98), max(high.max(), 1.02)
            ax.set_ylim(least - 0.05 * (most - least), most + 0.05 * (most - least))
            ax.set_title(it.title, fontsize=8)
        for ax in axes.ravel()[len(panels) :]:
            ax.set_visible(False)
        figure.supxlabel("number of the trial in the plan", fontsize=9)
        figure.supylabel("value over that at the first reference", fontsize=9)
        return svg_text(figure, simulated)
