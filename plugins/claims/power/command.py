"""`sliplab power`: how many trials the claims of a protocol need."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, EnableOption, JsonOption, ProtocolArgument
from sliplab.flows.running import console

if TYPE_CHECKING:
    from sliplab.flows.planning.plan_view import Forecast
    from sliplab.protocols import Plan
    from sliplab.storage.trials.store import Store

app = typer.Typer()


@app.command(epilog="Example: sliplab power my-protocol.yaml --store my-store")
def power(
    protocol: ProtocolArgument,
    store: Annotated[
        Path, typer.Option("--store", help="Folder of a store with trials of a pilot or a twin.")
    ],
    names: CampaignOption = None,
    claims: Annotated[
        list[str] | None,
        typer.Option(
            "--claim",
            help="In place of the protocol's claims: '{figure: accuracy, within: 1 %}'. "
            "Repeatable.",
        ),
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", help="The network that judges trials, in place of the protocol's."),
    ] = None,
    enable: EnableOption = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for the page and its numbers; default: STORE/report."),
    ] = None,
    draws: Annotated[
        int | None,
        typer.Option(
            "--draws",
            min=10,
            max=10_000,
            help="Campaigns to draw; default: 100, and 20 with order: adaptive.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, max=2**31, help="Of the draws.")] = 1,
    sessions: Annotated[
        int,
        typer.Option("--sessions", min=1, max=1000, help="Days, mountings or skins to plan for."),
    ] = 1,
    between: Annotated[
        float | None,
        typer.Option(
            "--between",
            min=0,
            max=100,
            help="Deviation between sessions, as a share of that between trials; default: the "
            "pilot's, or 0.3 where it is of one session.",
        ),
    ] = None,
    drift: Annotated[
        float,
        typer.Option(
            "--drift",
            min=0,
            max=100,
            help="From the first trial to the last, as a share of the deviation between trials.",
        ),
    ] = 0.0,
    network: Annotated[
        bool,
        typer.Option("--network", help="Train the network itself for the learning curve."),
    ] = False,
    no_training: Annotated[
        bool, typer.Option("--no-training", help="Leave the learning curve out.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Say after how many trials a protocol's claims are called, by a pilot's labelled trials."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    pilot = open_store(store)
    prepare_store(store)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected
    from sliplab.plugins.claims.power.flow import (
        Classifier,
        measure_power,
        plan_with_claims,
        request,
    )
    from sliplab.plugins.claims.power.page import forecast_of
    from sliplab.plugins.claims.power.resampling import Sessions

    plan, judging = plan_with_claims(protocol, claims or (), enable or (), model)
    classifier: Classifier | None = "network" if network else "logistic"
    if no_training:
        classifier = None
    time = Sessions(sessions, between, drift)
    asked = request(pilot, collected(pilot, names), plan, judging, draws, seed, classifier, time)
    out = pilot.folder / "report" if out is None else out
    found = measure_power(asked, out)
    if as_json:
        console.print_json({"page": str(out / "power.html"), **found.to_json()})
        return
    forecast_of(found).print()
    console.say(f"page: {out / 'power.html'}")


def forecast(plan: Plan, pilot: Store) -> Forecast:
    """Return what a pilot foretells of a plan's claims, for `sliplab plan`.

    Raises:
        InputError: the plan has no claims, or the pilot cannot tell.
    """
    from sliplab.plugins.claims.power.flow import of_plan
    from sliplab.plugins.claims.power.page import forecast_of

    return forecast_of(of_plan(plan, pilot))
