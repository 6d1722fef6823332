"""`sliplab generalise`: the network on skins and levels that it never saw."""

from __future__ import annotations

from typing import Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store


def generalise(
    folder: StoreArgument,
    factor: Annotated[
        list[str] | None, typer.Option("--factor", help="Only this factor; may be given again.")
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option("--level", help="Leave out this level, such as '0 deg'; may be given again."),
    ] = None,
    every: Annotated[
        bool, typer.Option("--all", help="Leave out each level in turn; else each factor's lowest.")
    ] = False,
    skins: Annotated[
        int | None,
        typer.Option("--skins", min=0, max=1000, help="Other skins of a simulated rig (5)."),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1_000_000, help="On each other skin.")
    ] = 36,
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, max=10_000, help="Of each training; the protocol's."),
    ] = None,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train without a level and test on it; test the network on other simulated skins."""
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)
    from sliplab.analysis.campaigns import collected
    from sliplab.analysis.sweeps.generalisation import COLUMNS, row_cells
    from sliplab.flows.generalise import measure_generalisation

    result = measure_generalisation(
        store, collected(store, campaign), factor or (), level or (), every, skins, trials, epochs
    )
    if as_json:
        console.print_json(result)
        return
    simulated = ", simulated" if result["simulated"] else ""
    rows = [row_cells(name, row) for name, row in result["results"].items()]
    console.print_table(f"generalise{simulated}", COLUMNS, rows)
    console.say(f"kept in {result['file']}; the next report shows it")


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command()(generalise)
