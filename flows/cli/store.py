"""`sliplab trials`, `verify` and `migrate`: a store looked at and looked after."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption, PlaceArgument, StoreArgument, located
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

SHOWN = (
    "campaign", "trial", "recorded_s", "events", "frames", "frame_source", "attempt", "simulated"
)  # fmt: skip
"""Columns of the catalogue that fit a terminal."""


def trials(
    store: PlaceArgument,
    where: Annotated[
        str | None, typer.Option("--where", help="Only rows for which this holds.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", help="Write a .csv, .parquet or .json file instead.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """The catalogue of committed trials as a table, and what was set aside, with causes."""
    from sliplab.flows.collecting.aside_view import all_aside, show_aside
    from sliplab.storage.trials.catalogue import catalogue, query
    from sliplab.storage.trials.store import Store

    unreadable: list[str] = []
    opened = Store.open(located(store))
    table = catalogue(opened, unreadable)
    whole = None
    if not unreadable and len(table):  # else what is whole may be more than what can be read
        whole = {name: set(part) for name, part in table.groupby("campaign")["trial"]}
    aside = all_aside(opened, unreadable, whole)
    for problem in unreadable:
        console.say(f"left out: {problem}")
    if where is not None:
        try:
            table = query(table, where)
        except ValueError as error:
            raise InputError("--where", "", where, str(error)) from None
    if output is not None:
        from sliplab.storage.formats.tables import write_table

        write_table(table, output)
        console.say(f"{len(table)} trials: {output}")
    if as_json:
        import json

        console.print_json(
            {
                "count": len(table),
                "trials": json.loads(table.to_json(orient="records")),
                "set_aside": aside,
                "unreadable": unreadable,
            }
        )
    elif output is None:
        shown = [name for name in SHOWN if name in table.columns]
        rows = [list(row) for row in table[shown].itertuples(index=False)]
        simulated = " (simulated)" if len(table) and table["simulated"].all() else ""
        spare = len(shown) - 2  # a row is its campaign and its trial
        console.print_table(f"trials of {store}{simulated}", shown, rows, limit=40, spare=spare)
        show_aside(aside)
        console.say(f"{len(table)} trials; --json and --output have all {table.shape[1]} columns")


def verify(
    store: PlaceArgument,
    quarantine: Annotated[
        bool,
        typer.Option("--quarantine", help="Set damaged trials aside, to be taken again."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check every checksum, count and clock of a store; changes nothing unless told to."""
    from sliplab.storage.trials.store import Store
    from sliplab.storage.trials.verify import set_aside, trial_folders
    from sliplab.storage.trials.verify import verify as look
    from sliplab.storage.urls import is_url

    if is_url(store):
        from sliplab.flows.cli.remote import verify_pushed

        verify_pushed(store, quarantine, as_json)
        return
    opened = Store.open(Path(store))
    total = sum(len(trial_folders(campaign)) for campaign in opened.campaigns())
    with console.bar("verify (trials)", total) as bar:
        problems = look(opened, lambda name: bar.advance(1, name))
    moved: list[str] = []
    if quarantine and any(item.trial for item in problems):
        from sliplab.flows.collecting.run_session import owned

        with owned(opened):
            moved = set_aside(opened, problems)
        console.say(f"{len(moved)} damaged trials are in quarantine; `sliplab collect` takes them")
    if as_json:
        damaged = len({(item.campaign, item.trial) for item in problems if item.trial})
        console.print_json(
            {
                "trials": total,
                "whole": total - damaged,
                "damaged": damaged,
                "format": opened.format,
                "ok": not problems,
                "problems": [vars(item) for item in problems],
                "quarantined": moved,
            }
        )
    elif problems:
        rows = [[item.path, item.what] for item in problems]
        console.print_table(f"{len(problems)} problems", ["where", "what is wrong"], rows)
    else:
        console.show(f"{total} trials, all as they were committed")
    if problems:
        raise typer.Exit(console.FAILED)


def migrate(store: StoreArgument, as_json: JsonOption = False) -> None:
    """Bring a store of an older version to this one's format; copies of what changes are kept.

    `collect` does the same before it begins.
    """
    from sliplab.storage.errors import translated_disk_errors
    from sliplab.storage.trials.lock import exclusive
    from sliplab.storage.trials.migrate import kept
    from sliplab.storage.trials.migrate import migrate as migrate_store
    from sliplab.storage.trials.store import Store

    opened = Store.open(store)
    with (
        translated_disk_errors(opened.folder),
        exclusive(opened.folder / ".lock", f"the store {opened.folder}"),
    ):
        passed = migrate_store(opened)
    copies = [str(kept(opened, number)) for number in passed]
    if as_json:
        console.print_json({"format": opened.format, "from": passed, "copies": copies})
    elif passed:
        console.show(f"format {passed[0]} to {opened.format}; copies: {copies}")
    else:
        console.show(f"nothing to do: format {opened.format} is the newest")


def register(app: typer.Typer) -> None:
    """Make them commands of `app`."""
    for command in (trials, verify, migrate):
        app.command()(command)
