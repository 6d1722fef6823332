"""`sliplab register`: a protocol, its claims and its analysis settings before the first trial."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import (
    PLAN,
    EnableOption,
    JsonOption,
    ProtocolArgument,
    StoreOption,
    finish,
)
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

app = typer.Typer()


@app.command(rich_help_panel=PLAN, epilog="Example: sliplab register pilot --store my-store")
def register(
    protocol: ProtocolArgument,
    store: StoreOption,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="A rig file or name, to be registered as well.")
    ] = None,
    enable: EnableOption = None,
    campaign: Annotated[
        str | None,
        typer.Option("--campaign", help="Campaign name; default: the protocol's name."),
    ] = None,
    stamp: Annotated[
        Path | None,
        typer.Option(
            "--stamp",
            help="Attach a time stamp (.tsr by RFC 3161, .ots by OpenTimestamps) to the "
            "campaign's registration that it is of, instead of registering again.",
        ),
    ] = None,
    show: Annotated[
        bool,
        typer.Option(
            "--show", help="List the campaign's registrations and deviations; register nothing."
        ),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Register protocol, claims and analysis settings; the report lists every later deviation.

    A file is added to the store, which a third party can stamp or sign; none is ever overwritten.
    """
    if show:
        _show(protocol, store, campaign, as_json)
        return
    if stamp is not None:
        _attach(protocol, store, campaign, stamp, as_json)
        return
    from sliplab.flows.register import register as run
    from sliplab.storage.files import sha256
    from sliplab.storage.trials.registration import registrations

    found, path = run(protocol, store, enable=enable or (), campaign=campaign, rig=rig)
    *earlier, (_, made) = registrations(found)
    if made.after != "before the first trial":
        console.say(f"warning: registered {made.after}")
    if earlier:
        console.say(f"note: {found.name} was registered before: {earlier[0][0]} counts")
    result = {
        "campaign": found.name,
        "number": made.number,
        "file": str(path),
        "sha256": sha256(path),
        "registered": made.registered,
        "when": made.after,
        "planned": made.planned,
        **(made.taken.to_json() if as_json else {}),
    }
    finish(result, f"registered in {store}", as_json)


def _show(protocol: Path, store: Path, campaign: str | None, as_json: bool) -> None:
    """Print whether a campaign is registered, and what deviates from that; no evaluation is needed.

    Raises:
        NoStore: there is no store.
        InputError: the protocol.
    """
    from sliplab.analysis.campaigns import collected
    from sliplab.analysis.report.registration import registration_section
    from sliplab.flows.register import registration_line
    from sliplab.protocols.plan import load_plan
    from sliplab.storage.trials.store import TrialStore

    opened, plan = TrialStore.open(store), load_plan(protocol)
    found = opened.campaign(campaign or plan.name)
    line = registration_line(found, plan)
    section = registration_section(opened, collected(opened, [found.name])) if found.begun else None
    tables = [] if section is None else [item.deviations for item in section.campaigns]
    rows = [dict(zip(table.columns, row, strict=True)) for table in tables for row in table.rows]
    if as_json:
        console.print_json({"campaign": found.name, "registered": line, "deviations": rows})
        return
    console.show(line)
    for table in tables:
        console.print_table("deviations", table.columns, table.rows or [["none", "", ""]])


def _attach(protocol: Path, store: Path, campaign: str | None, stamp: Path, as_json: bool) -> None:
    """Attach a stamp to the registration that it is of.

    Raises:
        InputError: the campaign is not registered, or the stamp is of none of its registrations.
    """
    from sliplab.protocols.plan import load_plan
    from sliplab.storage.trials.registration import attach_stamp, registration_files
    from sliplab.storage.trials.store import TrialStore

    found = TrialStore.open(store).campaign(campaign or load_plan(protocol).name)
    files = registration_files(found)
    if not files:
        raise InputError("--stamp", "", str(stamp), f"{found.folder} has no registration yet")
    target = attach_stamp(files, stamp)
    finish({"campaign": found.name, "file": str(target)}, f"stamped in {store}", as_json)
