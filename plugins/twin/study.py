"""`sliplab calibrate scene`: a simulated rig fitted to a pilot, and what its scene lacks."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import RigOption, StoreArgument
from sliplab.flows.running import console
from sliplab.plugins.twin.document import EffectNeed, ParameterFit, TwinFit
from sliplab.plugins.twin.options import SeedOption, SpreadOption, WorldsOption, one_campaign

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table
    from sliplab.plugins.twin.shown import SameTrials

WOULD_IDENTIFY = {
    "frames": "trials with the outside camera's frames",
    "events": "trials with an event camera",
    "force": "a force sensor at the pilot (docs/force.md)",
}


def measure(
    folder: StoreArgument,
    rig: RigOption,
    out: Annotated[Path, typer.Option("--out", help="The twin's rig file to write (YAML).")],
    campaign: Annotated[
        str | None, typer.Option("--campaign", help="The pilot; may be left out if it is alone.")
    ] = None,
    worlds: WorldsOption = 240,
    spread: SpreadOption = 0.5,
    seed: SeedOption = 1,
    gain_error: Annotated[
        float,
        typer.Option(
            "--gain-error",
            min=0,
            max=0.5,
            help="Largest error of the force sensor's gain, a share: what a check with known "
            "weights leaves.",
        ),
    ] = 0.15,
) -> Finding[TwinFit]:
    """Fit a simulated rig's scene to a labelled pilot: writes a rig file, a page and numbers.

    Ends with exit code 1 where the pilot shows an effect that the scene lacks.
    """
    store, item = one_campaign(folder, campaign)
    from sliplab.plugins.twin.calibrate import calibrate_scene, request

    wanted = request(rig, out, worlds, spread, seed, gain_error)
    return finding(out, *calibrate_scene(store, item, wanted))


def finding(out: Path, fit: TwinFit, trials: SameTrials) -> Finding[TwinFit]:
    """Return a fit with its files beside the twin's rig file."""
    return Finding(fit, out.parent, out.stem, failed=bool(fit.misfits), more=(out, trials))


def shown(fit: TwinFit, out: Path, trials: SameTrials) -> Iterator[Table | str]:
    """Yield the table of parameters, the cheapest scene, and misfits."""
    from sliplab.analysis.report.page import Table
    from sliplab.plugins.twin.needs.flow import cheapest_path

    rows = [
        [
            it.title,
            f"{it.assumed:.4g}",
            f"{it.value:.4g}" if it.identified else "-",
            "withheld" if it.low is None or it.high is None else f"{it.low:.4g} to {it.high:.4g}",
            it.unit,
            "yes" if it.identified else "no",
        ]
        for it in fit.parameters
    ]
    yield Table(
        ("parameter", "assumed", "fitted", "95 %", "unit", "identified"),
        rows,
        f"twin of the {'simulated ' if fit.simulated else ''}pilot '{fit.campaign}'",
    )
    if fit.gain_error:
        yield (
            "force gain or stiffness: no pilot tells them apart; intervals of the stiffnesses and "
            f"of the image's shift and growth allow for a gain that is off by {fit.gain_error:.0%}"
        )
    if fit.needs:
        asked = ", ".join(it.title for it in fit.needs if it.verdict == "asked for")
        yield f"the pilot asks for: {asked or 'none of the effects'}"
        left = ", ".join(it.title for it in fit.needs if it.left_out)
        yield (
            "cheapest scene: the twin itself"
            if fit.cheapest is None
            else f"cheapest scene: {cheapest_path(out)}, {fit.cheapest.time:.2f} of the twin's "
            f"time, without {left}"
        )
    yield f"{fit.worlds} worlds, {console.duration(fit.seconds)}; twin: {out}"
    for check in fit.misfits:
        yield f"misfit: the pilot's {check.stream} show what this scene lacks: {check.title}"
    withheld = sum(bool(it.withheld) for it in fit.parameters)
    if withheld:
        yield f"intervals of {withheld} parameters are withheld: the misfits touch them"


def view(fit: TwinFit, out: Path, trials: SameTrials) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.page import Figure, Table
    from sliplab.plugins.twin import plot

    simulated = fit.simulated
    return {
        "name": out.stem,
        "minutes": f"{fit.seconds / 60:.1f} min" if fit.seconds >= 60 else f"{fit.seconds:.0f} s",
        "misfits": Table(
            ("check", "stream", "pilot", "most that the scene shows"),
            [
                [it.title, it.stream, *(f"{x:.3g} {it.unit}".strip() for x in (it.pilot, it.limit))]
                for it in fit.misfits
            ],
        ),
        "intervals": Figure(plot.intervals(fit.parameters, simulated=simulated)),
        "parameters": Table(
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
        "missing": _missing(fit, trials.streams),
        "compared": Table(
            ("quantity", "pilot", "twin differs by", "rig file by", "scatter"),
            [
                [it.title, *map(_short, (it.pilot, it.twin, it.before, it.scatter))]
                for it in fit.compared
            ],
        ),
        "figures": [
            (Figure(svg), caption) for svg, caption in plot.of_trials(trials, simulated=simulated)
        ],
        "needs": Table(
            ("effect", "verdict", "loss", "90 % interval", "chance", "shown by", "time"),
            [_need(it) for it in fit.needs],
        ),
        "statistics": Table(
            ("statistic", "pilot", "worlds from", "to"),
            [
                [key, *map(_short, (it.pilot, it.low, it.high))]
                for key, it in fit.statistics.items()
            ],
        ),
    }


def _short(value: float | None) -> str:
    if value is None:
        return "–"
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
    return [
        it.title,
        f"{it.verdict}; left out" if it.left_out else it.verdict,
        f"{it.loss:.3f}",
        f"{it.low:.3f} to {it.high:.3f}",
        "–" if it.limit is None else f"{it.limit:.3f}",
        it.shown_by,
        "–" if it.time is None else f"{it.time:.2f}",
    ]


def _missing(fit: TwinFit, streams: frozenset[str]) -> Table | None:
    """Return what is not identified, and which trials would identify it."""
    from sliplab.analysis.report.page import Table
    from sliplab.plugins.twin.parameters import PARAMETERS

    known = {parameter.key: parameter for parameter in PARAMETERS}
    found: dict[str, list[str]] = {}
    for it in fit.parameters:
        if not it.identified:
            lacking = [name for name in known[it.key].streams if name not in streams]
            needs = ", ".join(WOULD_IDENTIFY[name] for name in lacking)
            found.setdefault(needs or "more trials of the same kind", []).append(it.title)
    rows = [[needs, "; ".join(titles)] for needs, titles in found.items()]
    return Table(("would be identified by", "parameters"), rows) if rows else None


STUDY = Study(
    name="scene",
    title="A fit of a simulated rig to a pilot, by SlipLab",
    measure=measure,
    result=TwinFit,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab calibrate scene my-store --rig my-rig.yaml --out twin.yaml",
    kind="twin",
)
