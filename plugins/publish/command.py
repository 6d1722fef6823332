"""`sliplab publish`: a store as a data set that others cite and load."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import (
    DATA,
    CampaignOption,
    JsonOption,
    PlaceArgument,
    finish,
    located,
)
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean, one_of

if TYPE_CHECKING:
    from sliplab.plugins.publish.publication import Publication
    from sliplab.storage.trials.store import Campaign, Store

app = typer.Typer()


@app.command(
    rich_help_panel=DATA,
    epilog="Example: sliplab publish my-store --as croissant --output published",
)
def publish(
    store: PlaceArgument,
    form: Annotated[str, typer.Option("--as", help="Format: croissant or mcap or lerobot.")],
    output: Annotated[Path, typer.Option("--output", help="The new folder; must not exist.")],
    campaign: CampaignOption = None,
    title: Annotated[
        str | None, typer.Option("--title", help="Title; default: the campaigns' names.")
    ] = None,
    creator: Annotated[
        list[str] | None, typer.Option("--creator", help="Name of an author. Repeatable.")
    ] = None,
    licence: Annotated[
        str | None, typer.Option("--licence", help="SPDX id of the licence, such as CC-BY-4.0.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Publish committed trials as a data set in one folder, with a data card and checksums."""
    from sliplab.plugins.publish.forms import forms
    from sliplab.plugins.publish.forms import publish as write
    from sliplab.plugins.publish.publication import About, Publication
    from sliplab.storage.process import now
    from sliplab.storage.remote.mirror import open_store

    if form not in (known := forms()):
        raise InputError("--as", "", form, one_of(form, known))
    opened = open_store(located(store))
    campaigns = _campaigns(opened, campaign)
    names = ", ".join(item.name for item in campaigns)
    about = About(
        f"Tactile slip trials: {names}" if title is None else title,
        tuple(creator or ()),
        licence,
        now()[:10],
    )
    publication = Publication(opened, campaigns, about, _splits(campaigns))
    if licence is None:
        console.say("warning: no --licence: nobody may use the data until there is one")
    with console.bar("publish (trials)", publication.count) as bar:
        result = write(publication, output, form, lambda name: bar.advance(1, name))
    finish(result, f"published in {output}{_mark(publication)}", as_json)


def _mark(publication: Publication) -> str:
    return " (simulated data)" if publication.simulated else ""


def _campaigns(store: Store, names: Sequence[str] | None) -> tuple[Campaign, ...]:
    """Return the campaigns of a store, or those named."""
    known = {item.name: item for item in store.campaigns()}
    for name in names or ():
        if name not in known:
            there = ", ".join(known) or "none"
            raise InputError(
                "--campaign",
                "",
                name,
                f"must be a campaign of the store: {there}{did_you_mean(name, known)}",
            )
    return tuple(known[name] for name in sorted(set(names or known)))


def _splits(campaigns: Sequence[Campaign]) -> dict[tuple[str, str], str]:
    """Return the part of the split of every trial that has one."""
    from sliplab.analysis.campaigns import Collected, has_plan

    splits = {}
    for campaign in campaigns:
        if not has_plan(campaign.info):
            continue
        for trial in Collected(campaign).planned:
            splits[campaign.name, trial.id] = trial.split
    return splits
