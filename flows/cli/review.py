"""`sliplab review` and `sliplab view`: manual label review, and one trial in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.flows.ui.review import TrialList

app = typer.Typer()


@app.command()
def review(
    store: StoreArgument,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Port of the page; default: a free one.")
    ] = 0,
    campaign: CampaignOption = None,
    who: Annotated[
        str, typer.Option("--who", help="Reviewer's name; default: the login name.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Review the labels in a browser on this computer; Ctrl-C ends it.

    Decisions are kept in STORE/review; `train` and `evaluate` use them with --reviewed.
    """
    from sliplab.flows.ui.review_server import serve
    from sliplab.storage.remote.mirror import open_store

    def ready(address: str, trials: TrialList) -> None:
        waiting = sum(row.state in {"open", "stale"} for row in trials.rows)
        if as_json:
            summary = {"url": address, "trials": len(trials.rows), "to_decide": waiting}
            console.print_json(summary)
        else:
            console.say(f"{len(trials.rows)} trials, {waiting} to review. Ctrl-C ends the page:")
            console.show(address)

    serve(open_store(store), campaign or (), port, who, ready)


@app.command()
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
    from sliplab.flows.ui import view as looking
    from sliplab.storage.remote.mirror import open_store

    subject = looking.find(open_store(store), trial, campaign)
    if save is None:
        looking.show(subject)
        if as_json:
            console.print_json({"trial": trial, "file": None})
        return
    if save.suffix != ".rrd" or not save.parent.is_dir():
        raise InputError("--save", "", str(save), "must end in .rrd and its folder must exist")
    counts = looking.save(subject, save)
    if as_json:
        console.print_json({"file": str(save), "trial": trial, **counts})
    else:
        summary = {**counts, "bytes": console.size(counts["bytes"])}
        console.print_pairs(f"{save} (open it with `rerun {save}`)", summary)
