"""`sliplab holdout`: the study's network on a campaign that nothing was chosen by."""

from __future__ import annotations

from typing import Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.flows.study_defaults import HELD_OUT


def holdout(
    folder: StoreArgument,
    trials: Annotated[
        int, typer.Option("--trials", min=2, max=1_000_000, help="Spread over the conditions.")
    ] = HELD_OUT,
    again: Annotated[
        bool,
        typer.Option("--again", help="Also where this version of SlipLab judged it already."),
    ] = False,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Judge the network once on another simulated skin and seed, which choose nothing."""
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)
    from sliplab.analysis.campaigns import collected
    from sliplab.analysis.report.holdout import COLUMNS, holdout_part, holdout_rows
    from sliplab.flows.holdout import measure_holdout

    done = measure_holdout(store, collected(store, campaign), trials, again)
    if as_json:
        console.print_json(done)
        return
    result = done["result"]
    console.print_table("hold-out, simulated", COLUMNS, holdout_rows(holdout_part(result)))
    console.say(f"kept in {done['file']}, with its ledger; the next report shows it")


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command()(holdout)
