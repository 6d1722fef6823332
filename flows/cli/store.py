"""`sliplab trials`, `verify`, `migrate`, `push` and `pull`: local and remote stores."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.cli.common import (
    DATA,
    CampaignOption,
    JsonOption,
    PlaceArgument,
    StoreArgument,
)
from sliplab.flows.running import console, exit_codes
from sliplab.flows.steps import located
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import did_you_mean, plural

if TYPE_CHECKING:
    from sliplab.storage.trials.store import Campaign, TrialStore

app = typer.Typer()

SHOWN = (
    "campaign",
    "trial",
    "recorded_s",
    "events",
    "frames",
    "frame_source",
    "attempt",
    "simulated",
    "unread_bytes",
    "rows_lost",
    "no_clock",
)
"""Columns of the catalogue that fit a terminal."""


@app.command(rich_help_panel=DATA, epilog="Example: sliplab trials my-store")
def trials(
    store: PlaceArgument,
    where: Annotated[
        str | None, typer.Option("--where", help="Filter rows by an expression: depth_mm == 3.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", help="Write a .csv, .parquet or .json file instead.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List committed trials, and those that are not taken again, with their causes."""
    from sliplab.flows.planning.campaign_trials import all_excluded, print_excluded
    from sliplab.storage.remote.mirror import open_store
    from sliplab.storage.trials.catalogue import catalogue, query

    unreadable: list[str] = []
    opened = open_store(located(store))
    table = catalogue(opened, unreadable)
    whole = None
    if not unreadable and len(table):  # else what is whole may be more than what can be read
        whole = {str(name): set(part) for name, part in table.groupby("campaign")["trial"]}
    excluded = all_excluded(opened, unreadable, whole)
    for problem in unreadable:
        console.say(f"left out: {problem}")
    if where is not None:
        table = query(table, where, "--where")
    if output is not None:
        from sliplab.storage.trials.catalogue import check_table_path, write_table

        check_table_path(output)
        write_table(table, output)
        console.say(f"{plural(len(table), 'trial')}: {output}")
    if as_json:
        from sliplab.storage.trials.catalogue import table_records

        console.print_json(
            {
                "count": len(table),
                "trials": table_records(table),
                "set_aside": excluded,
                "unreadable": unreadable,
            }
        )
    elif output is None:
        shown = [name for name in SHOWN if name in table.columns]
        rows = [list(row) for row in table[shown].itertuples(index=False)]
        simulated = " (simulated)" if len(table) and table["simulated"].all() else ""
        spare = len(shown) - 2  # a row is its campaign and its trial
        console.print_table(f"trials of {store}{simulated}", shown, rows, limit=40, spare=spare)
        print_excluded(excluded)
        console.say(
            f"{plural(len(table), 'trial')}; --json and --output have all {table.shape[1]} columns"
        )


@app.command(rich_help_panel=DATA, epilog="Example: sliplab verify my-store")
def verify(
    store: PlaceArgument,
    quarantine: Annotated[
        bool,
        typer.Option("--quarantine", help="Move damaged trials to quarantine, to be retaken."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Check every checksum, count and clock of a store; close files that others left open.

    Unfinished trials, and the one that is being recorded, are named and are no damage.
    """
    from sliplab.flows.verify import verify as run
    from sliplab.storage.trials.verify import DAMAGED

    found = run(store, quarantine)
    problems = found["problems"]
    wrong = [item for item in problems if item.kind == DAMAGED]
    for path in found.get("mended", ()):
        console.say(f"{path}: another program had left it open for writing; as committed again")
    if moved := found.get("quarantined"):
        console.say(
            f"{plural(len(moved), 'damaged trial')} quarantined; `sliplab collect` retakes what a "
            "protocol asks for"
        )
    for trial in found.get("salvaged", ()):
        console.say(f"{trial}: was salvaged from a damaged file: intact, but not all of it")
    for trial, gates in found.get("failed_gates", {}).items():
        console.say(
            f"{trial}: does not pass {', '.join(gates)}: intact, but not used by later steps"
        )
    for trial, reasons in found.get("dropped", {}).items():
        counts = ", ".join(f"{count} {reason}" for reason, count in reasons.items())
        console.say(f"{trial}: intact, but without {counts}")
    for trial, refused in found.get("no_clock", {}).items():
        for stream, why in refused.items():
            console.say(f"{trial}: intact, but {stream} has no clock: {why}")
    if as_json:
        console.print_json(found)
    else:
        for item in problems:
            if item.kind != DAMAGED:
                console.say(f"{item.path}: {item.what}")
        if wrong:
            rows = [[item.path, item.what] for item in wrong]
            console.print_table(plural(len(wrong), "problem"), ["where", "what is wrong"], rows)
        else:
            console.show(f"{plural(found['trials'], 'trial')}, all intact")
    if wrong:
        raise typer.Exit(exit_codes.FAILED)


@app.command(rich_help_panel=DATA, epilog="Example: sliplab migrate my-store")
def migrate(store: StoreArgument, as_json: JsonOption = False) -> None:
    """Migrate an older store to the current format; changed files are backed up first.

    `collect` does the same before it begins.
    """
    from sliplab.storage.errors import translated_disk_errors
    from sliplab.storage.trials.lock import exclusive
    from sliplab.storage.trials.migrate import migrate as migrate_store
    from sliplab.storage.trials.migrate import retained
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    with (
        translated_disk_errors(opened.folder),
        exclusive(opened.folder / ".lock", f"the store {opened.folder}"),
    ):
        passed = migrate_store(opened)
    copies = [str(retained(opened, number)) for number in passed]
    if as_json:
        console.print_json({"format": opened.format, "from": passed, "copies": copies})
    elif passed:
        console.show(f"format {passed[0]} to {opened.format}; copies: {copies}")
    else:
        console.show(f"nothing to do: format {opened.format} is the current one")


UrlArgument = Annotated[
    str, typer.Argument(help="URL of the remote store: s3://bucket/folder, file:///shared/folder.")
]
QuarantineOption = Annotated[
    bool, typer.Option("--quarantine", help="Include quarantined trials and their causes.")
]
FOLLOW_S = 30.0
"""Period of `push --follow`, s."""


@app.command(rich_help_panel=DATA, epilog="Example: sliplab push my-store s3://bucket/my-store")
def push(
    store: StoreArgument,
    url: UrlArgument,
    campaign: CampaignOption = None,
    quarantine: QuarantineOption = False,
    follow: Annotated[
        bool, typer.Option("--follow", help="Keep pushing until the running collection has ended.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Read the remote files back and resend damaged ones.")
    ] = False,
    sizes_only: Annotated[
        bool, typer.Option("--sizes-only", help="Check sizes only; do not read sent files back.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace", help="Replace trials of the same name pushed from another store."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Upload committed trials to shared or object storage; rerun to upload new ones.

    It may run while trials are taken. Keys and addresses of servers come from the environment.
    """
    from sliplab.flows.collecting.requests import holder_of
    from sliplab.flows.running import stopping
    from sliplab.storage.remote.objects import Remote
    from sliplab.storage.remote.push import PushOptions
    from sliplab.storage.remote.push import push as send
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    chosen = _chosen(opened, campaign)
    remote = Remote(url)
    options = PushOptions(quarantine, replace, not sizes_only, check)
    done = None
    while True:
        collects = follow and _collects(holder_of(store))
        total = sum(len(item.committed()) for item in chosen)
        with console.bar(f"push {store} (trials)", total) as bar:
            now = send(
                opened,
                remote,
                chosen,
                options,
                lambda name: bar.advance(1, name),
                lambda _: stopping.check(),
            )
        if done is None:
            done = now
        else:
            done.add(now)
        if not collects:
            break
        stopping.wait(FOLLOW_S)
    _finish({"url": remote.url, "simulated": opened.simulated, **vars(done)}, "push", as_json)


@app.command(rich_help_panel=DATA, epilog="Example: sliplab pull s3://bucket/my-store my-copy")
def pull(
    url: UrlArgument,
    store: Annotated[Path, typer.Argument(help="The store's folder; created if missing.")],
    campaign: CampaignOption = None,
    quarantine: QuarantineOption = False,
    as_json: JsonOption = False,
) -> None:
    """Download pushed trials into a store and check each one; rerun to get new ones."""
    from sliplab.storage.remote.objects import Remote
    from sliplab.storage.remote.pull import pull as pull_trials

    with console.bar(f"pull {url} (trials)", 0) as bar:
        done = pull_trials(
            Remote(url),
            store,
            campaigns=campaign,
            quarantine=quarantine,
            on_trial=bar.count,
            on_bytes=lambda _: bar.advance(0),
        )
    _finish({"url": url, "store": str(store), **vars(done)}, "pull", as_json)


def _chosen(store: TrialStore, names: list[str] | None) -> list[Campaign]:
    there = {campaign.name: campaign for campaign in store.campaigns()}
    for name in names or ():
        if name not in there:
            text = f"is not in {store.folder}; there are {', '.join(there)}"
            text += did_you_mean(name, there)
            raise InputError("--campaign", "", name, text)
    return [there[name] for name in (names or there)]


def _collects(holder: Mapping[str, object] | None) -> bool:
    return bool(holder and holder.get("collects"))


def _finish(result: dict[str, Any], what: str, as_json: bool) -> None:
    """Print the result; problems end the program with exit 1."""
    problems = result["problems"]
    for problem in problems:
        console.say(f"left out: {problem}")
    if as_json:
        console.print_json(result)
    else:
        shown = {key: value for key, value in result.items() if key != "problems"}
        shown["bytes"] = console.size(result["bytes"])
        console.print_pairs(what, {**shown, "left out": len(problems)})
    if problems:
        raise typer.Exit(exit_codes.FAILED)
