"""`sliplab serve`: the deployments of one rig on Prefect's page, with schedules."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption, RigOption, StoreOption
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store


def serve(
    store: StoreOption,
    rig: RigOption,
    schedules: Annotated[
        Path | None, typer.Argument(help="A file of schedules (YAML): nights, weekends.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Of the deployments; the rig's by default.")
    ] = None,
    port: Annotated[
        int, typer.Option("--port", min=0, max=65535, help="Of the embedded server's page; 0: any.")
    ] = 4200,
    poll: Annotated[
        float, typer.Option("--poll", min=0.2, max=60, help="Look for new runs so often, s.")
    ] = 3.0,
    check: Annotated[
        bool, typer.Option("--check", help="Read the file, say what would run when, and end.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Serve collect, label, train, evaluate, report, study and chain; Ctrl-C ends, arm first."""
    from sliplab.flows.serving.serve_file import load_schedules
    from sliplab.rigs.rig_file import load_rig_file
    from sliplab.rigs.rig_inheritance import rig_path

    found = [] if schedules is None else load_schedules(schedules)
    file, _ = load_rig_file(rig)
    if check:
        rows = [[i.name, i.flow, i.cron, i.timezone, i.active, i.parameters] for i in found]
        if as_json:
            console.print_json({"schedules": [item.model_dump() for item in found]})
        else:
            columns = ["name", "flow", "cron", "time zone", "active", "parameters"]
            console.print_table(f"schedules of {schedules}", columns, rows)
        return
    prepare_store(store)
    from sliplab.flows.serving.serve import serve as run
    from sliplab.storage.trials.store import Store

    run(
        Store.open(store),
        str(rig_path(rig).resolve()),
        name or file.name,
        found,
        folders=[Path.cwd(), *([] if schedules is None else [schedules.parent])],
        port=port,
        poll_s=poll,
    )
    if as_json:
        console.print_json({"served": str(store), "name": name or file.name})


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command()(serve)
