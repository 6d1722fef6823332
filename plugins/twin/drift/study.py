"""`sliplab calibrate drift`: what a campaign's reference trials show of the skin's wear."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import RigOption, StoreArgument
from sliplab.flows.running import console
from sliplab.plugins.twin.drift.document import DriftFit, ParameterDrift
from sliplab.plugins.twin.options import SeedOption, SpreadOption, WorldsOption, one_campaign
from sliplab.storage.errors import StoreError

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

HEADER = ("parameter", "at first", "per 100 trials", "over the campaign", "changed")


def measure(
    folder: StoreArgument,
    rig: RigOption,
    campaign: Annotated[
        str | None, typer.Option("--campaign", help="May be left out if the store has one.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the page and its numbers; default: STORE/report."),
    ] = None,
    limit: Annotated[
        float | None,
        typer.Option(
            "--limit",
            min=0.1,
            max=1000,
            help="Exit with 1 if friction changed by more than so many percent.",
        ),
    ] = None,
    worlds: WorldsOption = 300,
    spread: SpreadOption = 0.5,
    seed: SeedOption = 1,
) -> Finding[DriftFit]:
    """Fit a campaign's reference trials one by one: wear of the skin, drift of the rig."""
    store, item = one_campaign(folder, campaign)
    from sliplab.plugins.twin.calibrate import fitted_rig
    from sliplab.plugins.twin.drift.flow import calibrate_drift

    fit = calibrate_drift(
        store,
        item,
        fitted_rig(rig),
        worlds=worlds,
        spread=spread,
        seed=seed,
        limit_percent=limit,
    )
    out = store.folder / "report" if out is None else out
    error = None
    if limit is not None and not fit.friction.identified:
        error = StoreError(
            f"campaign '{fit.campaign}': its single references do not tell of friction, which "
            "--limit is for: press deeper or slide further in collection.references "
            f"({out}/drift.html)"
        )
    return Finding(fit, out, failed=fit.beyond, error=error)


def shown(fit: DriftFit) -> Iterator[Table | str]:
    """Yield the table of identified parameters, and whether friction is within its limit."""
    from sliplab.analysis.report.page import Table

    kind = "simulated campaign" if fit.simulated else "campaign"
    yield Table(
        HEADER, [_row(it) for it in fit.identified], f"drift of the {kind} '{fit.campaign}'"
    )
    yield f"{fit.worlds} worlds, {console.duration(fit.seconds)}"
    if fit.limit_percent is not None:
        yield _verdict(fit, fit.friction, fit.limit_percent)


def view(fit: DriftFit) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.page import Figure, Table
    from sliplab.plugins.twin.plot import ParameterTrend, trends

    panels = [
        ParameterTrend(
            it.title,
            [one.place for one in it.references],
            [(one.low, one.factor, one.high) for one in it.references],
            it.percent_per_100_trials,
        )
        for it in fit.identified
    ]
    return {
        "condition": ", ".join(f"{name} {value}" for name, value in fit.condition.items()),
        "count": len(fit.parameters[0].references),
        "figure_of_all": Figure(trends(panels, simulated=fit.simulated)) if panels else None,
        "table_of_all": Table(HEADER, [_row(it) for it in fit.identified]),
        "others": [it.title for it in fit.parameters if not it.identified],
    }


def _row(it: ParameterDrift) -> list[str]:
    """Return an identified parameter as a row below `HEADER`."""
    start = f"{it.start:,.0f}" if it.start >= 1000.0 else f"{it.start:.3g}"
    return [
        it.title,
        f"{start} {it.unit}".strip(),
        _percent(it.percent_per_100_trials, it.low, it.high),
        _percent(it.change_percent, it.change_low, it.change_high),
        "yes" if it.changed else "no",
    ]


def _percent(middle: float, low: float, high: float) -> str:
    return f"{middle:+.1f} % ({low:+.1f} to {high:+.1f})"


def _verdict(fit: DriftFit, friction: ParameterDrift, limit_percent: float) -> str:
    found = (
        f"campaign '{fit.campaign}': {friction.title} changed by {friction.change_percent:+.1f} % "
        f"(95 %: {friction.change_low:+.1f} to {friction.change_high:+.1f}) over "
        f"{len(friction.references)} {'simulated ' if fit.simulated else ''}reference trials; at "
        f"most {limit_percent:g} % is allowed"
    )
    if not fit.beyond:
        return f"{found}: within, or not surely beyond"
    return (
        f"{found}. The skin wears: look at it, clean or change it, and take the trials since then "
        "again with `sliplab again`"
    )


STUDY = Study(
    name="drift",
    title="The drift of a campaign's reference trials, by SlipLab",
    measure=measure,
    result=DriftFit,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab calibrate drift my-store --rig twin.yaml",
)
