"""`sliplab guesses`: what a study's figures owe to the guessed numbers of its simulated scene."""

from __future__ import annotations

from typing import Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store


def guesses(
    folder: StoreArgument,
    guess: Annotated[
        list[str] | None,
        typer.Option("--guess", help="Only this number of the scene; may be given again."),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=2, max=1_000_000, help="Test trials of each campaign.")
    ] = 20,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Take some test trials again with each guess 20 % down and up, and judge them anew."""
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)
    from sliplab.analysis.campaigns import collected
    from sliplab.analysis.sweeps.sensitivity import FIGURES, UNITS
    from sliplab.flows.guesses import GUESSES, measure_guesses

    result = measure_guesses(store, collected(store, campaign), tuple(guess or GUESSES), trials)
    if as_json:
        console.print_json(result)
        return
    columns = [f"{FIGURES[name]} ({UNITS[name]})" for name in FIGURES]
    rows = []
    for name, found in result["settings"].items():
        shown = [
            "-"
            if value is None
            else f"{100 * value:.1f}"
            if key == "strict"
            else f"{value:.3f}"
            if UNITS[key] == "mm"
            else f"{value:.0f}"
            for key, value in found.items()
        ]
        rows.append([name.removeprefix("scene.").removeprefix("event_camera."), *shown])
    console.print_table("guesses, simulated", ["setting", *columns], rows)
    console.say(f"kept in {result['file']}; the next report shows them")


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command()(guesses)
