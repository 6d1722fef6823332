"""`sliplab alerts`: watch a store, and tell people what happens."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, StoreArgument
from sliplab.flows.running import console, exit_codes

app = typer.Typer()
LOCK = ".alerts.lock"


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab alerts my-store alerts.yaml --test")
def alerts(
    store: StoreArgument,
    file: Annotated[
        Path, typer.Argument(help="A file (YAML) with a section `alerts:`, such as the schedules.")
    ],
    test: Annotated[
        bool, typer.Option("--test", help="Send one message to each address, and exit.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Tell people by mail or chat when a run fails, a pause lasts, or a campaign is done."""
    from contextlib import ExitStack
    from datetime import datetime

    from sliplab.flows.running import stopping
    from sliplab.plugins.alerts.settings import load_alerts
    from sliplab.plugins.alerts.targets import AppriseTarget, Target
    from sliplab.plugins.alerts.watcher import POLL_S, AlertWatcher
    from sliplab.storage.errors import disk_fault
    from sliplab.storage.trials.lock import exclusive
    from sliplab.storage.trials.store import TrialStore

    opened, settings = TrialStore.open(store), load_alerts(file)
    targets: list[Target] = [AppriseTarget(address) for address in settings.to]
    if test:
        taken = {
            item.name: item.send("SlipLab: test", f"Alerts of {opened.folder.name} arrive here.")
            for item in targets
        }
        if as_json:
            console.print_json({"taken": taken})
        else:
            for name, well in taken.items():
                console.show(f"{name}: {'taken' if well else 'NOT taken'}")
        if not all(taken.values()):
            raise typer.Exit(exit_codes.FAILED)
        return
    with ExitStack() as held:
        try:
            held.enter_context(exclusive(opened.folder / LOCK, f"alerts of {opened.folder}"))
        except OSError as error:
            if (fault := disk_fault(error)) is None:
                raise
            text = "alerts go out without a lock, and twice if another program sends them"
            console.say(f"the disk of {opened.folder} {fault}: {text}")
        now = datetime.now().astimezone()
        watcher = AlertWatcher(opened, settings, targets, now, console.say)
        console.say(f"watching {opened.folder}; Ctrl-C ends")
        while True:
            watcher.look(datetime.now().astimezone())
            stopping.wait(POLL_S)
