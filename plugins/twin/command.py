"""`sliplab calibrate scene`, `drift`, `gap`: a simulated rig fitted to trials of a rig."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, RigOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.analysis.campaigns import Collected
    from sliplab.storage.trials.store import Store

app = typer.Typer()

WorldsOption = Annotated[
    int, typer.Option("--worlds", min=100, max=100_000, help="Worlds to simulate.")
]
SpreadOption = Annotated[
    float,
    typer.Option(
        "--spread", min=0.05, max=5, help="Largest change of a parameter: 0.5 is by half."
    ),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, max=2**31, help="Seed of the simulated worlds.")
]


def _campaigns_of(folder: Path, names: list[str] | None) -> tuple[Store, list[Collected]]:
    """Return a store and its campaigns of these names; all without any."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected

    return store, collected(store, names)


def _only(found: list[Collected]) -> Collected:
    """Return the campaign if it is the only one."""
    if len(found) != 1:
        names = ", ".join(item.name for item in found)
        raise InputError("--campaign", "", None, f"is needed: the store has {names}")
    return found[0]


@app.command(
    "scene", epilog="Example: sliplab calibrate scene my-store --rig my-rig.yaml --out twin.yaml"
)
def calibrate_scene(
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
    as_json: JsonOption = False,
) -> None:
    """Fit a simulated rig's scene to a labelled pilot: writes a rig file, a page and numbers.

    Ends with exit code 1 where the pilot shows an effect that the scene lacks.
    """
    store, found = _campaigns_of(folder, None if campaign is None else [campaign])
    from sliplab.plugins.twin.calibrate import calibrate_scene as fit_to
    from sliplab.plugins.twin.calibrate import request
    from sliplab.plugins.twin.needs.flow import cheapest_path

    wanted = request(rig, out, worlds, spread, seed, gain_error)
    fit = fit_to(store, _only(found), wanted)
    misfits = [check for check in fit.checks if check.found]
    if as_json:
        console.print_json({"rig": str(out), **fit.to_json()})
        if misfits:
            raise typer.Exit(console.FAILED)
        return
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
    pilot = "simulated pilot" if fit.simulated else "pilot"
    console.print_table(
        f"twin of the {pilot} '{fit.campaign}'",
        ["parameter", "assumed", "fitted", "95 %", "unit", "identified"],
        rows,
    )
    if fit.gain_error:
        console.say(
            "force gain or stiffness: no pilot tells them apart; intervals of the stiffnesses and "
            f"of the image's shift and growth allow for a gain that is off by {fit.gain_error:.0%}"
        )
    if fit.needs:
        asked = ", ".join(it.title for it in fit.needs if it.verdict == "asked for")
        console.say(f"the pilot asks for: {asked or 'none of the effects'}")
        left = ", ".join(it.title for it in fit.needs if it.left_out)
        console.say(
            "cheapest scene: the twin itself"
            if fit.cheapest is None
            else f"cheapest scene: {cheapest_path(out)}, {fit.cheapest.time:.2f} of the twin's "
            f"time, without {left}"
        )
    console.say(f"{fit.worlds} worlds, {console.duration(fit.seconds)}; twin: {out}")
    console.say(f"page: {out.with_suffix('.html')}")
    for check in misfits:
        console.say(f"misfit: the pilot's {check.stream} show what this scene lacks: {check.title}")
    withheld = sum(bool(it.withheld) for it in fit.parameters)
    if withheld:
        console.say(f"intervals of {withheld} parameters are withheld: the misfits touch them")
    if misfits:
        raise typer.Exit(console.FAILED)


@app.command("drift", epilog="Example: sliplab calibrate drift my-store --rig twin.yaml")
def calibrate_drift(
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
    as_json: JsonOption = False,
) -> None:
    """Fit a campaign's reference trials one by one: wear of the skin, drift of the rig."""
    store, found = _campaigns_of(folder, None if campaign is None else [campaign])
    from sliplab.plugins.twin.calibrate import fitted_rig
    from sliplab.plugins.twin.drift.flow import calibrate_drift as fit_to
    from sliplab.plugins.twin.drift.flow import verdict
    from sliplab.plugins.twin.drift.page import HEADER, row

    simulated = fitted_rig(rig)
    out = store.folder / "report" if out is None else out
    fit = fit_to(
        store,
        _only(found),
        simulated,
        out,
        worlds=worlds,
        spread=spread,
        seed=seed,
        limit_percent=limit,
    )
    page = out / "drift.html"
    if as_json:
        console.print_json({"page": str(page), **fit.to_json()})
    else:
        kind = "simulated campaign" if fit.simulated else "campaign"
        known = [it for it in fit.parameters if it.identified]
        console.print_table(
            f"drift of the {kind} '{fit.campaign}'", HEADER, [row(it) for it in known]
        )
        console.say(f"{fit.worlds} worlds, {console.duration(fit.seconds)}; page: {page}")
    if fit.limit_percent is not None:
        console.say(verdict(fit))
    if fit.beyond:
        raise typer.Exit(console.FAILED)


@app.command(
    "gap",
    epilog="Example: sliplab calibrate gap my-store --rig twin.yaml --protocol kinematic --out gap",
)
def calibrate_gap(
    folder: StoreArgument,
    rig: Annotated[Path, typer.Option("--rig", help="The twin's rig file (YAML).")],
    protocol: Annotated[
        Path, typer.Option("--protocol", help="Protocol whose training trials are simulated.")
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the page and of simulated trials.")],
    names: CampaignOption = None,
    worlds: Annotated[
        int, typer.Option("--worlds", min=1, max=1000, help="Rigs drawn from the twin's posterior.")
    ] = 8,
    as_json: JsonOption = False,
) -> None:
    """Train networks on a twin, and test them on the labelled test trials of its real rig."""
    store, campaigns = _campaigns_of(folder, names)
    from sliplab.plugins.twin.gap.flow import NAME, measure_gap, request
    from sliplab.plugins.twin.gap.page import COLUMNS, cells

    found = measure_gap(request(store, campaigns, rig, protocol, out, worlds))
    if as_json:
        console.print_json({"folder": str(out), **found.to_json()})
        return
    trials = plural(found.trials, ("simulated " if found.simulated else "") + "test trial")
    rows = [cells(it) for it in found.networks]
    console.print_table(f"gap of the twin {found.rig}, {trials}", COLUMNS, rows, spare=4)
    console.say(f"page: {out / NAME}.html")
