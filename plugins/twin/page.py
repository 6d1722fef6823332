"""The page of a twin: fitted parameters, their accuracy, and effects that the scene lacks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from sliplab.analysis.report.page import Figure, Table, render_page
from sliplab.plugins.twin import plot as figures
from sliplab.plugins.twin.document import EffectNeed, ParameterFit, TwinFit
from sliplab.plugins.twin.parameters import PARAMETERS
from sliplab.plugins.twin.shown import Course, Shown
from sliplab.storage.streams import F64

PANELS = 3
"""Test trials that are drawn over time."""
WOULD_IDENTIFY = {
    "frames": "trials with the outside camera's frames",
    "events": "trials with an event camera",
    "force": "a force sensor at the pilot (docs/force.md)",
}


def render(
    fit: TwinFit,
    name: str,
    pilot: Sequence[Shown],
    twin: Sequence[Sequence[Shown]],
    before: Sequence[Sequence[Shown]],
    rings: F64,
    streams: frozenset[str],
) -> str:
    """Return the page as text.

    Args:
        name: of the twin. pilot: test trials. twin, before: worlds with the same trials.
        rings: layer of each marker, (m,). streams: that the pilot has.
    """
    minutes = f"{fit.seconds / 60:.1f} min" if fit.seconds >= 60 else f"{fit.seconds:.0f} s"
    misfits = [
        [
            check.title,
            check.stream,
            f"{check.pilot:.3g} {check.unit}".strip(),
            f"{check.limit:.3g} {check.unit}".strip(),
        ]
        for check in fit.checks
        if check.found
    ]
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=fit.simulated,
        fit=fit,
        name=name,
        rig=fit.rig,
        minutes=minutes,
        misfits=Table(("check", "stream", "pilot", "most that the scene shows"), misfits),
        intervals=Figure(_intervals(fit)),
        parameters=Table(
            ("parameter", "key", "assumed", "fitted", "95 % interval", "identified"),
            [
                [
                    f"{it.title} ({it.unit})" if it.unit else it.title,
                    it.key,
                    _short(it.assumed),
                    _short(it.value) if it.identified else "–",
                    _interval(it),
                    _identified(it),
                ]
                for it in fit.parameters
            ],
        ),
        missing=_missing(fit, streams),
        compared=Table(
            ("quantity", "pilot", "twin differs by", "rig file by", "scatter"),
            [
                [it.title, *(_short(v) for v in (it.pilot, it.twin, it.before, it.scatter))]
                for it in fit.compared
            ],
        ),
        figures=_figures(pilot, twin, before, rings, fit.simulated) if pilot else [],
        needs=Table(
            ("effect", "verdict", "loss", "90 % interval", "chance", "shown by", "time"),
            [_need(it) for it in fit.needs],
        ),
        statistics=Table(
            ("statistic", "pilot", "worlds from", "to"),
            [
                [key, *("–" if v is None else _short(v) for v in (it.pilot, it.low, it.high))]
                for key, it in fit.statistics.items()
            ],
        ),
    )


def _short(value: float) -> str:
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _interval(it: ParameterFit) -> str:
    if it.low is None or it.high is None:
        return f"withheld: {'; '.join(it.withheld)}"
    return f"{_short(it.low)} to {_short(it.high)}"


def _identified(it: ParameterFit) -> str:
    if not it.identified:
        return "no"
    if it.low is None or it.high is None:
        return "withheld"
    return "at the edge" if it.low <= it.least or it.high >= it.most else "yes"


def _need(it: EffectNeed) -> list[str]:
    if it.loss is None or it.low is None or it.high is None:
        return [it.title, it.verdict, "–", "–", "–", it.shown_by or "–", "–"]
    verdict = f"{it.verdict}; left out" if it.left_out else it.verdict
    return [
        it.title,
        verdict,
        f"{it.loss:.3f}",
        f"{it.low:.3f} to {it.high:.3f}",
        "–" if it.limit is None else f"{it.limit:.3f}",
        it.shown_by,
        "–" if it.time is None else f"{it.time:.2f}",
    ]


def _intervals(fit: TwinFit) -> str:
    rows = [
        figures.Factor(
            it.title,
            it.low / it.assumed,
            it.value / it.assumed,
            it.high / it.assumed,
            it.least / it.assumed,
            it.most / it.assumed,
            it.identified,
        )
        if it.low is not None and it.high is not None
        else figures.Factor(
            f"{it.title} (withheld)",
            math.nan,
            math.nan,
            math.nan,
            it.least / it.assumed,
            it.most / it.assumed,
            False,
        )
        for it in fit.parameters
    ]
    return figures.intervals(rows, simulated=fit.simulated)


def _missing(fit: TwinFit, streams: frozenset[str]) -> Table | None:
    """Return what is not identified, and which trials would identify it."""
    known = {parameter.key: parameter for parameter in PARAMETERS}
    found: dict[str, list[str]] = {}
    for it in fit.parameters:
        if it.identified:
            continue
        lacking = [name for name in known[it.key].streams if name not in streams]
        needs = ", ".join(WOULD_IDENTIFY[name] for name in lacking)
        found.setdefault(needs or "more trials of the same kind", []).append(it.title)
    rows = [[needs, "; ".join(titles)] for needs, titles in found.items()]
    return Table(("would be identified by", "parameters"), rows) if rows else None


def _figures(
    pilot: Sequence[Shown],
    twin: Sequence[Sequence[Shown]],
    before: Sequence[Sequence[Shown]],
    rings: F64,
    simulated: bool,
) -> list[tuple[Figure, str]]:
    """Return figures of the test trials, each with its caption."""
    found = []
    events = all(trial.map is not None for trial in pilot)
    if events:
        rates = _curves(pilot, twin, before, lambda trial: trial.rate)
        svg = figures.over_time(rates, "positive events/s", simulated=simulated)
        found.append((Figure(svg), "Positive events per second, in bins of 0.1 s."))
    moved = _curves(pilot, twin, before, lambda trial: trial.moved)
    svg = figures.over_time(moved, "moved (mm)", simulated=simulated)
    found.append((Figure(svg), "Mean displacement of the markers along the slide."))
    of_pilot = np.stack([trial.slips_s for trial in pilot])
    order = [
        np.nanmedian([[trial.slips_s for trial in world] for world in worlds], axis=0)
        for worlds in (twin, before)
    ]
    svg = figures.slip_order(of_pilot, order[0], order[1], rings, simulated=simulated)
    found.append(
        (
            Figure(svg),
            "Time of each marker's slip in each test trial, since the slide began: median of the "
            "worlds, over the pilot's.",
        )
    )
    if events:
        means = [
            np.mean([it.map for world in worlds for it in world if it.map is not None], axis=0)
            for worlds in ([pilot], twin, before)
        ]
        svg = figures.maps(means[0], means[1], means[2], simulated=simulated)
        caption = "Positive events of the slides in the middle of the event camera's picture."
        found.append((Figure(svg), caption))
    return found


def _curves(
    pilot: Sequence[Shown],
    twin: Sequence[Sequence[Shown]],
    before: Sequence[Sequence[Shown]],
    of: Callable[[Shown], Course | None],
) -> list[figures.Curves]:
    """Return a course of the first trials, the worlds' at the times of the pilot's."""
    found = []
    for k, trial in enumerate(pilot[:PANELS]):
        own = of(trial)
        theirs = [[of(world[k]) for world in worlds] for worlds in (twin, before)]
        if own is not None:
            aligned = (
                np.stack([np.interp(own[0], *course) for course in courses if course is not None])
                for courses in theirs
            )
            found.append(figures.Curves(trial.trial, *own, *aligned))
    return found
