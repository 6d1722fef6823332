"""`sliplab stress`: the detectors of a store under nuisances."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.shown import plural

app = typer.Typer()


@app.command(epilog="Example: sliplab stress my-study")
def stress(
    store: StoreArgument,
    names: CampaignOption = None,
    protocol: Annotated[
        Path,
        typer.Option("--protocol", help="With nuisances; a file, or one that ships: nuisances."),
    ] = Path("nuisances"),
    rig: Annotated[
        Path | None,
        typer.Option("--rig", help="Rig of these trials; default: the simulated one of STORE."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", help="Folder for trials, page and numbers; default: STORE/stress."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Take trials under nuisances, and judge the detectors that STORE trained by them."""
    from sliplab.flows.steps import prepare_store
    from sliplab.storage.remote.mirror import open_store

    found = open_store(store)
    prepare_store(store)  # before anything imports Prefect
    from sliplab.analysis.campaigns import collected
    from sliplab.plugins.bench.stress.flow import measure_stress, request
    from sliplab.plugins.bench.stress.judging import ALL
    from sliplab.plugins.bench.stress.page import COLUMNS, cells, of, title

    asked = request(found, collected(found, names), protocol, rig, out)
    record = measure_stress(asked)
    if as_json:
        console.print_json({"page": str(asked.out / "stress.html"), **record.to_json()})
        return
    simulated = " (simulated)" if record.simulated else ""
    console.print_table(
        f"{plural(record.trials, 'trial')} under nuisances, {record.hold_h:.2f} h of "
        f"holding{simulated}",
        COLUMNS,
        [cells(title(detector), of(detector, ALL)) for detector in record.detectors],
    )
    console.say(f"page: {asked.out / 'stress.html'}")
