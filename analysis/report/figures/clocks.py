"""Figures of clocks: uncertainty by trial, residuals over a trial, any value over a campaign."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.artist import Artist
from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PURPLE,
    STYLE,
    WIDTH,
    svg_text,
)

F64 = npt.NDArray[np.float64]


COLOURS = {"events": BLUE, "frames": ORANGE, "arm": GREEN}


MARKS = {"events": "o", "frames": "s", "arm": "^"}

FURTHER = (PURPLE, "#56B4E9", "#882255", GREY, "#8C564B")
"""Colours of further devices, which have labels as well."""


def colour_of(device: str) -> str:
    """Return a device's colour: its own, or one that depends on its name alone."""
    return COLOURS.get(device) or FURTHER[zlib.crc32(device.encode()) % len(FURTHER)]


BINS = 40


DENSE = 2000
"""From this many marks on they are drawn as pixels, not as shapes."""


def uncertainty_by_trial(
    devices: Mapping[str, tuple[Sequence[int], Sequence[float]]],
    starts: Mapping[str, int],
    *,
    simulated: bool,
) -> str:
    """Each device's uncertainty over all trials of a store, SVG.

    Args:
        devices: name, with its grade, to numbers of trials and microseconds.
        starts: the number of each campaign's first trial.
    """
    marks = zip(COLOURS.values(), ("o", "s", "^"), strict=True)  # devices come in this order
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.8))
        for (name, (numbers, values)), (colour, mark) in zip(devices.items(), marks, strict=False):
            axes.plot(
                numbers,
                values,
                mark,
                color=colour,
                ms=2.5,
                mew=0,
                alpha=0.6,
                label=name,
                rasterized=len(numbers) >= 250,
            )
        axes.set_yscale("log")
        axes.margins(y=0.35)
        for place, (name, first) in enumerate(starts.items()):
            axes.axvline(first, color=GREY, lw=0.6)
            axes.annotate(  # below each other: a small campaign is narrower than its name
                f" {name}",
                (first, 1),
                xycoords=("data", "axes fraction"),
                fontsize=7,
                va="top",
                xytext=(0, -8 * place),
                textcoords="offset points",
            )
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylabel("uncertainty, 95 % (µs)")
        axes.set_xlabel("trial, campaign after campaign")
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3, fontsize=8, markerscale=2
        )
        return svg_text(figure, simulated)


@dataclass(frozen=True)
class Residuals:
    """Residuals of one device, over the time of a trial.

    Attributes:
        title: what the device is, with its grade.
        time_s, residual_us: of all trials together.
        worst_s, worst_us: of the worst trial alone.
        worst: which trial that is.
    """

    device: str
    title: str
    time_s: F64
    residual_us: F64
    worst_s: F64
    worst_us: F64
    worst: str


@dataclass(frozen=True)
class GateLine:
    """A limit over the trials from `first` to `last`."""

    first: float
    last: float
    value: float
    device: str


@dataclass(frozen=True)
class OverTrials:
    """A panel with one value a trial.

    Attributes:
        label: the axis' name, with its unit.
        series: by device: its name for people, the trials' numbers, their values.
        logarithmic: values run over decades; otherwise `whole` says that they are counts.
    """

    label: str
    series: Mapping[str, tuple[str, Sequence[float], Sequence[float]]]
    gates: Sequence[GateLine] = ()
    logarithmic: bool = False
    whole: bool = False


def residuals(devices: Sequence[Residuals], *, simulated: bool) -> str:
    """One panel a device: median and 95 % of all trials, and the worst trial's own points."""
    with plt.rc_context(STYLE):
        figure, panels = plt.subplots(
            len(devices), 1, figsize=(7.6, 2.1 * len(devices) + 0.6), sharex=True, squeeze=False
        )
        for axes, device in zip(panels[:, 0], devices, strict=True):
            colour = colour_of(device.device)
            middle, low, median, high = pooled(device.time_s, device.residual_us)
            axes.fill_between(
                middle, low, high, color=colour, alpha=0.25, lw=0, label="95 % of all trials"
            )
            axes.plot(middle, median, color=colour, lw=1.4, label="median of all trials")
            axes.plot(
                device.worst_s,
                device.worst_us,
                ".",
                color="black",
                ms=3,
                mew=0,
                label="worst trial",
            )
            axes.axhline(0, color=GREY, lw=0.6)
            axes.set_title(f"{device.title}; worst trial {device.worst}", fontsize=8)
            axes.set_ylabel("residual (µs)")
        panels[-1, 0].set_xlabel("time since the trial's first pulse (s)")
        handles, names = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside lower center", ncols=3, fontsize=8)
        return svg_text(figure, simulated)


def pooled(time_s: F64, values: F64) -> tuple[F64, F64, F64, F64]:
    """Middles of `BINS` stretches of time that hold values, with their 2.5, 50 and 97.5 %."""
    edges = np.linspace(time_s.min(), np.nextafter(time_s.max(), np.inf), BINS + 1)
    where = np.clip(np.searchsorted(edges, time_s, side="right") - 1, 0, BINS - 1)
    there = np.unique(where)
    shares = np.array([np.quantile(values[where == k], (0.025, 0.5, 0.975)) for k in there])
    middles: F64 = (edges[:-1] + edges[1:])[there] / 2
    return middles, shares[:, 0], shares[:, 1], shares[:, 2]


def over_trials(
    panels: Sequence[OverTrials], campaigns: Mapping[str, float], *, simulated: bool
) -> str:
    """Panels one below the other over the trials in the order in which they were taken.

    Args:
        campaigns: by name, the number of its first trial.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(panels), 1, figsize=(7.6, 1.8 * len(panels) + 1.3), sharex=True, squeeze=False
        )
        handles: dict[str, Artist] = {}
        for axes, panel in zip(grid[:, 0], panels, strict=True):
            _panel(axes, panel)
            for first in list(campaigns.values())[1:]:
                axes.axvline(first - 0.5, color=GREY, lw=0.8, ls=":")
            shown, names = axes.get_legend_handles_labels()
            handles |= dict(zip(names, shown, strict=True))
        for name, first in campaigns.items():
            grid[0, 0].annotate(
                name,
                (first - 0.5, 1.0),
                xycoords=("data", "axes fraction"),
                fontsize=8,
                color=GREY,
                xytext=(3, 3),
                textcoords="offset points",
            )
        # whole trials: round a single one the names would be far outside, and nothing fit
        numbers = [x for panel in panels for _, xs, _ in panel.series.values() for x in xs]
        if numbers:
            grid[-1, 0].set_xlim(min(campaigns.values()) - 0.5, max(numbers) + 0.5)
        grid[-1, 0].set_xlabel("trial, in the order taken")
        grid[-1, 0].xaxis.set_major_locator(MaxNLocator(integer=True))
        if handles:
            figure.legend(
                handles.values(), handles.keys(), loc="outside lower center", ncols=3, fontsize=8
            )
        return svg_text(figure, simulated)


def _panel(axes: Any, panel: OverTrials) -> None:
    offsets = 0.15 * (np.arange(len(panel.series)) - (len(panel.series) - 1) / 2)
    for (device, (name, numbers, values)), offset in zip(
        panel.series.items(), offsets, strict=True
    ):
        axes.plot(
            np.asarray(numbers) + offset,
            values,
            MARKS.get(device, "D"),
            ms=4,
            mew=0,
            alpha=0.75,
            color=colour_of(device),
            label=name,
            rasterized=len(numbers) > DENSE,
        )
    for gate in panel.gates:
        # gates of the same height alternate, so that both colours are seen
        begin = 4 * list(panel.series).index(gate.device)
        axes.plot(
            [gate.first - 0.5, gate.last + 0.5],
            [gate.value] * 2,
            ls=(begin, (4, 4)),
            lw=1.4,
            color=colour_of(gate.device),
            label=f"gate of {gate.device}",
        )
    axes.set_ylabel(panel.label)
    if panel.logarithmic:
        axes.set_yscale("log")
    elif panel.whole:
        axes.yaxis.set_major_locator(MaxNLocator(integer=True))
        axes.set_ylim(-0.5, None)
        axes.set_ylim(top=max(axes.get_ylim()[1], 1.5))
