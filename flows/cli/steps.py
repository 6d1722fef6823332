"""`sliplab sync`, `label`, `train`, `evaluate`, `report`: a step on what is stored."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flows.cli.common import (
    CampaignOption,
    DaskOption,
    JsonOption,
    PlaceArgument,
    finish,
    located,
    run_step,
    step,
)
from flows.running import console

ReviewedOption = Annotated[
    bool, typer.Option("--reviewed", help="Use what people decided in `sliplab review`.")
]


def sync(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Fit the clocks of every trial again and write report/sync.html about them."""
    result = run_step(located(store), campaign, "sync", dask)
    if as_json:
        console.print_json(result)
        return
    from flows.syncing.sync import COLUMNS, tables

    for title, rows in tables(result):
        console.print_table(title, COLUMNS, rows)
    console.show(
        "Median and worst: uncertainty of events against the device, both clocks together; "
        "of events that of their own clock."
    )
    simulated = " (simulated)" if result["simulated"] else ""
    console.show(f"Page{simulated}: {Path(result['page']).resolve()}")


def label(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the true onsets of every trial from its video, or from the tracks in its place."""
    step(store, campaign, as_json, "label", dask=dask)


def train(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    reviewed: ReviewedOption = False,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train the spiking network on the labelled kinematic trials."""
    step(store, campaign, as_json, "train", dask=dask, reviewed=reviewed)


def evaluate(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    margin: Annotated[
        float | None, typer.Option("--margin", min=0, max=1e6, help="Spikes a winner must lead by.")
    ] = None,
    smoothing: Annotated[
        int | None, typer.Option("--smoothing", min=1, max=1000, help="Windows to average over.")
    ] = None,
    reviewed: ReviewedOption = False,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Also train other methods to compare (minutes).")
    ] = False,
    checks: Annotated[
        bool, typer.Option("--checks", help="Fail if permuted or shuffled labels show a fault.")
    ] = False,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Score the network on trials it has never seen."""
    options = {"margin": margin, "smoothing": smoothing, "reviewed": reviewed}
    folder = located(store)
    result = run_step(folder, campaign, "evaluate", dask, **options)
    more = {"window_baselines": baselines, "window_checks": checks}
    for name, wanted in more.items():
        if wanted:
            result[name] = run_step(folder, campaign, name, reviewed=reviewed)
    finish(result, f"evaluate {store}", as_json)


def report(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    against: Annotated[
        Path | None,
        typer.Option("--against", help="Another store or its summary.json: what changed."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write report/index.html and report/summary.json, and compare with another report."""
    folder = located(store)
    if against is not None:
        from flows.reporting.report_against import load_other

        load_other(against)  # wrong input is told before anything is made
    result = run_step(folder, campaign, "report")
    if against is not None:
        from flows.reporting import report, report_against_page
        from storage.store import Store

        compared = report.against(Store.open(folder), against)
        if as_json:
            result["against"] = compared
        else:
            title = "Two reports" + (" (simulated)" if any(compared["simulated"].values()) else "")
            console.print_table(title, *report_against_page.short_table(compared["figures"]))
            console.show(f"Page: {compared['page']}")
    finish(result, f"report {store}", as_json)
    console.say(f"report: {folder / 'report' / 'index.html'}")


def register(app: typer.Typer) -> None:
    """Make them commands of `app`."""
    for command in (sync, label, train, evaluate, report):
        app.command()(command)
