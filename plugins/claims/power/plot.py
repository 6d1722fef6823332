"""Figures of how many trials claims need, over drawn campaigns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np

from sliplab.analysis.report.figures.style import (
    BLUE,
    GREY,
    PALETTE,
    RED,
    STYLE,
    WIDTH,
    svg_text,
)
from sliplab.plugins.claims.power.document import ClaimPower, Learning


def decisions(rows: Mapping[str, Sequence[int | None]], planned: int, *, simulated: bool) -> str:
    """Draw the share of campaigns in which each claim was called, over trials.

    Args:
        rows: trials of each campaign; None: never.
    """
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.4 + 0.16 * len(rows)))
        for k, (title, trials) in enumerate(rows.items()):
            ends = np.sort([n for n in trials if n is not None])
            x = np.concatenate([[0], ends, [planned]])
            share = np.concatenate([np.arange(len(ends) + 1), [len(ends)]]) / len(trials)
            last = k == len(rows) - 1 and len(rows) > 1
            axes.step(
                x,
                100.0 * share,
                where="post",
                label=title,
                lw=2.0 if last else 1.2,
                color="black" if last else PALETTE[k % len(PALETTE)],
                ls="--" if k >= len(PALETTE) and not last else "-",
            )
        axes.set_xlim(0, planned)
        axes.set_ylim(-2, 102)
        axes.set_xlabel("trials taken")
        axes.set_ylabel("campaigns called (%)")
        figure.legend(loc="outside lower center", ncols=1, fontsize=7.5)
        return svg_text(figure, simulated)


def widths(claims: Sequence[ClaimPower], *, simulated: bool) -> str:
    """Draw half the width of each claim's interval along some campaigns."""
    with plt.rc_context(STYLE):
        figure, grid = plt.subplots(
            len(claims), 1, figsize=(WIDTH, 1.5 * len(claims) + 0.4), sharex=True, squeeze=False
        )
        for axes, claim in zip(grid[:, 0], claims, strict=True):
            for line in claim.widths:
                half = [np.nan if value is None else value for value in line.half]
                axes.plot(line.trials, half, "o-", color=BLUE, lw=0.8, ms=2.5, alpha=0.6)
            if claim.width is not None:
                axes.axhline(claim.width, color=RED, lw=1.0)
            axes.set_ylim(bottom=0.0)
            axes.set_title(claim.claim, fontsize=7.5)
            axes.set_ylabel(f"+- {claim.unit}", fontsize=8)
        grid[-1, 0].set_xlabel("trials taken")
        return svg_text(figure, simulated)


def learning_curve(curve: Learning, *, simulated: bool) -> str:
    """Draw accuracy over training trials, measured and fitted."""
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(WIDTH, 2.6))
        line = np.array([(it.trials, it.accuracy, it.low, it.high) for it in curve.line])
        axes.fill_between(
            line[:, 0], 100.0 * line[:, 2], 100.0 * line[:, 3], color=BLUE, alpha=0.2, lw=0
        )
        axes.plot(line[:, 0], 100.0 * line[:, 1], color=BLUE, lw=1.2, label="fit, 95 %")
        for it in curve.points:
            axes.plot([it.trials] * 2, [100.0 * it.low, 100.0 * it.high], color="black", lw=1.2)
        axes.plot(
            [it.trials for it in curve.points],
            [100.0 * it.accuracy for it in curve.points],
            "o",
            color="black",
            ms=4,
            label="trained",
        )
        axes.axvline(curve.planned, color=GREY, lw=0.9, ls="--", label="whole plan")
        axes.set_xscale("log")
        ticks = sorted({*(it.trials for it in curve.points), curve.planned})
        axes.set_xticks(ticks, [str(tick) for tick in ticks])
        axes.minorticks_off()
        axes.set_xlabel("training trials")
        axes.set_ylabel("accuracy (%)")
        axes.legend(loc="lower right", fontsize=8)
        return svg_text(figure, simulated)
