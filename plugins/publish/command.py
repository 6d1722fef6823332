"""`sliplab export --as croissant`: a store as a data set that others cite and load."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, PlaceArgument
from sliplab.flows.cli.export import former
from sliplab.flows.exports import Export, ExportRequest, ExportResult
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean, one_of

if TYPE_CHECKING:
    from sliplab.storage.trials.store import Campaign, TrialStore

app = typer.Typer()


@app.command(hidden=True)
def publish(
    store: PlaceArgument,
    form: Annotated[str, typer.Option("--as")],
    output: Annotated[Path, typer.Option("--output")],
    campaign: CampaignOption = None,
    title: Annotated[str | None, typer.Option("--title")] = None,
    creator: Annotated[list[str] | None, typer.Option("--creator")] = None,
    licence: Annotated[str | None, typer.Option("--licence")] = None,
    as_json: JsonOption = False,
) -> None:
    """Former name of `export`."""
    from sliplab.plugins.publish.forms import forms

    if form not in forms():
        raise InputError("--as", "", form, one_of(form, forms()))
    given = {"campaign": campaign, "title": title, "creator": creator, "licence": licence}
    options = {name: value for name, value in given.items() if value is not None}
    former("publish", ExportRequest(store, "", form, output, options), as_json)


def write(request: ExportRequest) -> ExportResult:
    """Write committed trials as a data set in one folder, with a data card and checksums."""
    from sliplab.plugins.publish.forms import publish as publish_as
    from sliplab.plugins.publish.publication import Publication, PublicationInfo
    from sliplab.storage.process import now
    from sliplab.storage.remote.mirror import open_store

    options = request.options
    opened = open_store(Path(request.place))
    campaigns = _campaigns(opened, options.get("campaign"))
    names = ", ".join(item.name for item in campaigns)
    licence = options.get("licence")
    about = PublicationInfo(
        options.get("title", f"Tactile slip trials: {names}"),
        tuple(options.get("creator", ())),
        licence,
        now()[:10],
    )
    publication = Publication(opened, campaigns, about, _splits(campaigns))
    with console.bar("publish (trials)", publication.count) as bar:
        result = publish_as(
            publication, request.output, request.form, lambda name: bar.advance(1, name)
        )
    if licence is None:
        console.say("warning: no --licence: nobody may use the data until there is one")
    mark = " (simulated data)" if publication.simulated else ""
    return ExportResult(f"published in {request.output}{mark}", result)


EXPORT = Export("store", write, frozenset({"campaign", "title", "creator", "licence"}))


def _campaigns(store: TrialStore, names: Sequence[str] | None) -> tuple[Campaign, ...]:
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
