"""`sliplab view`: one trial in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import ANALYSE, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

app = typer.Typer()


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab view my-store TRIAL")
def view(
    store: StoreArgument,
    trial: Annotated[str, typer.Argument(help="A trial's id, as in `sliplab trials`.")],
    save: Annotated[
        Path | None,
        typer.Option("--save", help="Write an .rrd file instead of opening the viewer."),
    ] = None,
    campaign: Annotated[
        str | None, typer.Option("--campaign", help="The campaign, if several contain the trial.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Show a trial in Rerun: events, frames, arm, pulses, onsets, network on one time line."""
    from sliplab.plugins.view import view as looking
    from sliplab.storage.remote.mirror import open_store
    from sliplab.storage.trials.catalogue import refuse_store_file

    subject = looking.find(open_store(store), trial, campaign)
    if save is None:
        looking.show(subject)
        if as_json:
            console.print_json({"trial": trial, "file": None})
        return
    if save.suffix.lower() != ".rrd" or not save.parent.is_dir():
        raise InputError("--save", "", str(save), "must end in .rrd and its folder must exist")
    refuse_store_file(save, "--save")
    counts = looking.save(subject, save)
    if as_json:
        console.print_json({"file": str(save), "trial": trial, **counts})
    else:
        summary = {**counts, "bytes": console.size(counts["bytes"])}
        console.print_pairs(f"{save} (open it with `rerun {save}`)", summary)
