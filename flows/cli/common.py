"""Options that commands share, and functions to run a step and print its result."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.running import console
from sliplab.flows.steps import located, prepare_store, run_step

if TYPE_CHECKING:
    from sliplab.analysis.campaigns import Collected
    from sliplab.storage.trials.store import TrialStore

PLAN, COLLECT, RIG, ANALYSE, DATA = "Plan", "Collect", "Rig", "Analyse", "Data"
RESEARCH = "Research"
"""Panels of the help; commands of plug-ins are among those of research if they name no other."""

ProtocolArgument = Annotated[Path, typer.Argument(help="A protocol file (YAML).")]
StoreArgument = Annotated[Path, typer.Argument(metavar="STORE", help="A store's folder.")]
PlaceArgument = Annotated[
    str,
    typer.Argument(
        metavar="STORE", help="A store's folder, or the URL of a pushed one (s3://..., file://...)."
    ),
]
DaskOption = Annotated[
    str | None,
    typer.Option("--dask", help="HOST:PORT of a Dask scheduler whose workers process the trials."),
]
RigOption = Annotated[
    Path,
    typer.Option("--rig", help="A rig file (YAML), or the name of a built-in rig such as mock."),
]
StoreOption = Annotated[
    Path, typer.Option("--store", help="The store's folder; created if missing.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print one JSON object to stdout, everything else to stderr.")
]
EnableOption = Annotated[
    list[str] | None,
    typer.Option("--enable", help="Enable an optional level: factor=level. Repeatable."),
]
PromiseOption = Annotated[
    float | None,
    typer.Option(
        "--promise",
        min=0.001,
        max=1e6,
        help="Set levels so that false alarms an hour without slip are at most this, 95 % sure.",
    ),
]
CampaignOption = Annotated[
    list[str] | None, typer.Option("--campaign", help="Only this campaign. Repeatable.")
]


def step(place: str, names: list[str] | None, as_json: bool, step: str, **options: Any) -> None:
    """Run one analysis step on a store and print its result."""
    finish(run_step(located(place), names, step, **options), f"{step} {place}", as_json)


def finish(result: Mapping[str, object], title: str, as_json: bool) -> None:
    """Print a command's result, as one JSON object or for a person."""
    if as_json:
        console.print_json(result)
        return
    console.print_pairs(title, {key: _shown(value) for key, value in result.items()})


def _shown(value: object) -> object:
    """Return a value of a result as a person reads it."""
    if isinstance(value, list):
        return ", ".join(str(_shown(each)) for each in value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(each)}" for name, each in value.items()) or "none"
    return f"{value:.6g}" if isinstance(value, float) else value


def opened_campaigns(folder: Path, names: list[str] | None) -> tuple[TrialStore, list[Collected]]:
    """Return a store and its campaigns, before anything imports Prefect."""
    from sliplab.analysis.campaigns import collected
    from sliplab.storage.remote.mirror import open_store

    store = open_store(folder)
    prepare_store(folder)
    # commands that recompute from a protocol skip imported campaigns unless they are named
    found = collected(store, names)
    return store, [item for item in found if names or item.recorded is None] or found
