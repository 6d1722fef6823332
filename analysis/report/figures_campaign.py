"""Figures of a campaign in the order in which it was taken: how good its trials are, and wear."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter, NullLocator

from sliplab.analysis.report.figure_style import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    RED,
    STYLE,
    WIDTH,
    svg_text,
)

DENSE = 250
"""From this many marks on they are drawn as pixels, not as shapes."""


def over_campaign(
    numbers: Sequence[int],
    rates: Sequence[float],
    used: Sequence[float],
    again: Mapping[int, int],
    *,
    simulated: bool,
) -> str:
    """Event rate, the gate that was nearest to its limit, and attempts that failed; SVG.

    Args:
        numbers: places in the plan of the committed trials, from 1.
        rates: events a second of each; used: share of a gate's limit, 0..1, of each.
        again: attempts that are in quarantine, by place in the plan.
    """
    with plt.rc_context(STYLE):
        figure, (top, middle, low) = plt.subplots(
            3, 1, figsize=(WIDTH, 4.0), sharex=True, height_ratios=(2, 2, 1)
        )
        dots: dict[str, Any] = {"ms": 2.5, "mew": 0, "rasterized": len(numbers) >= DENSE}
        top.plot(numbers, [rate / 1000 for rate in rates], "o", color=BLUE, **dots)
        top.set_ylabel("events\n(thousand/s)")
        top.set_ylim(bottom=0)
        middle.plot(numbers, [100 * share for share in used], "o", color=GREEN, **dots)
        middle.axhline(100, color=RED, lw=0.9, ls="--", label="limit")
        middle.set_ylabel("tightest gate\n(% of its limit)")
        middle.set_ylim(0, 110)
        middle.legend(loc="center right", fontsize=8)
        low.bar(list(again), list(again.values()), color=ORANGE, width=max(1, len(numbers) / 200))
        low.set_ylabel("failed\nattempts")
        low.set_ylim(0, max(1, *again.values(), 1) + 0.2)
        low.yaxis.set_major_locator(MaxNLocator(3, integer=True))
        if not again:
            low.annotate("none", (0.5, 0.5), xycoords="axes fraction", color=GREY, ha="center")
        low.set_xlabel("trial, in the plan's order")
        return svg_text(figure, simulated)


def references(
    numbers: Sequence[int],
    panels: Mapping[str, Sequence[float | None]],
    *,
    simulated: bool,
) -> str:
    """What reference trials measured, over the campaign: a panel each, SVG.

    Args:
        numbers: places in the plan, from 1.
        panels: values of the trials by the name of the axis, with its unit.
    """
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(panels), 1, figsize=(WIDTH, 1.5 * len(panels) + 0.6), sharex=True, squeeze=False
        )
        for axes, (label, values) in zip(grid[:, 0], panels.items(), strict=True):
            there = [(n, v) for n, v in zip(numbers, values, strict=True) if v is not None]
            axes.plot([n for n, _ in there], [v for _, v in there], "o-", color=BLUE, ms=4, lw=0.7)
            if there:
                axes.axhline(there[0][1], color=GREY, lw=0.8, ls=":")
            axes.set_ylabel(label)
            axes.margins(y=0.3)
        grid[-1][0].set_xlabel("trial, in the plan's order")
        return svg_text(figure, simulated)


def clocks(
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
    marks = ((BLUE, "o"), (ORANGE, "s"), (GREEN, "^"))
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.8))
        for (name, (numbers, values)), (colour, mark) in zip(devices.items(), marks, strict=False):
            axes.plot(
                numbers, values, mark, color=colour, ms=2.5, mew=0, alpha=0.6, label=name,
                rasterized=len(numbers) >= DENSE,
            )  # fmt: skip
        axes.set_yscale("log")
        axes.margins(y=0.35)
        for place, (name, first) in enumerate(starts.items()):
            axes.axvline(first, color=GREY, lw=0.6)
            axes.annotate(  # below each other: a small campaign is narrower than its name
                f" {name}", (first, 1), xycoords=("data", "axes fraction"), fontsize=7, va="top",
                xytext=(0, -8 * place), textcoords="offset points",
            )  # fmt: skip
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_locator(NullLocator())
        axes.set_ylabel("uncertainty, 95 % (µs)")
        axes.set_xlabel("trial, campaign after campaign")
        axes.legend(
            loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=3, fontsize=8, markerscale=2
        )
        return svg_text(figure, simulated)


def label_uncertainty(
    errors: Mapping[str, Mapping[str, Sequence[float]]],
    widths: Mapping[str, Sequence[float]],
    *,
    simulated: bool,
) -> str:
    """How far labels are from the truth, and how sure they are of themselves; cumulated, SVG.

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
