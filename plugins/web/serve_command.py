"""`sliplab serve`: one rig's deployments, with schedules, on a page."""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, RigOption, StoreOption
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.plugins.web.page_command import PublicOption, origin
from sliplab.protocols.plugin import plugins

app = typer.Typer()

RUNS = 3
"""Upcoming runs of each schedule that `serve --check` shows."""
_SHOWN = "%a %Y-%m-%d %H:%M %Z"


@app.command(
    rich_help_panel=COLLECT,
    epilog="Example: sliplab serve schedules.yaml --store my-store --rig mock",
)
def serve(
    store: StoreOption,
    rig: RigOption,
    schedules: Annotated[
        Path | None, typer.Argument(help="A file of schedules (YAML): nights, weekends.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Name of the deployments; default: the rig's name.")
    ] = None,
    port: Annotated[
        int,
        typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any free port."),
    ] = 4200,
    poll: Annotated[
        float, typer.Option("--poll", min=0.2, max=60, help="Polling period for new runs, s.")
    ] = 3.0,
    check: Annotated[
        bool,
        typer.Option("--check", help="Validate the schedules, print the upcoming runs, and exit."),
    ] = False,
    public_url: PublicOption = "",
    as_json: JsonOption = False,
) -> None:
    """Serve the flows of one rig as Prefect deployments. Ctrl-C stops the arm, then all runs."""
    from sliplab.flows.running.orchestration import configure_prefect
    from sliplab.plugins.web.server.schedules import has_alerts, load_schedules, upcoming_runs
    from sliplab.rigs.rig_file import load_rig_file
    from sliplab.rigs.rig_inheritance import rig_path

    found = [] if schedules is None else load_schedules(schedules)
    files = [file for file in (schedules, rig_path(rig)) if file is not None]
    alerts = next(filter(has_alerts, files), None)
    if alerts is not None:
        plugins().hook("check_alerts")(alerts)
    file, _ = load_rig_file(rig)
    named = schedules or Path()
    if check:
        with TemporaryDirectory() as home:
            configure_prefect(Path(home))  # before anything imports Prefect
            runs = [
                times if item.active else []
                for item, times in zip(found, upcoming_runs(named, found, RUNS), strict=True)
            ]
        if as_json:
            listed = [
                {**item.model_dump(), "runs": [f"{time:%Y-%m-%dT%H:%M:%S%z}" for time in times]}
                for item, times in zip(found, runs, strict=True)
            ]
            console.print_json({"schedules": listed})
        else:
            rows = [[i.name, i.flow, i.cron, i.timezone, i.active, i.parameters] for i in found]
            columns = ["name", "flow", "cron", "time zone", "active", "parameters"]
            title = f"schedules of {schedules}" if schedules else "no file of schedules was given"
            console.print_table(title, columns, rows)
            due = [(time, item) for item, times in zip(found, runs, strict=True) for time in times]
            rows = [
                [f"{time:{_SHOWN}}", end and f"{end:{_SHOWN}}", item.name, item.flow]
                for time, item in sorted(due, key=itemgetter(0))
                for end in [item.end(time)]
            ]
            console.print_table("upcoming runs", ["begins", "until", "name", "flow"], rows)
        return
    prepare_store(store)
    upcoming_runs(named, found, RUNS)
    from sliplab.plugins.web.server.serve import serve as run
    from sliplab.storage.trials.store import TrialStore

    run(
        TrialStore.open(store),
        str(rig_path(rig).resolve()),
        name or file.name,
        found,
        folders=[Path.cwd(), *([] if schedules is None else [schedules.parent])],
        port=port,
        poll_s=poll,
        alerts=alerts,
        shown=schedules and schedules.resolve(),
        public=origin(public_url),
    )
    if as_json:
        console.print_json({"served": str(store), "name": name or file.name})
