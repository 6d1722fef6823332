"""`sliplab status` and `sliplab log`: how a store's campaigns stand, and who did what."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import COLLECT, CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of

if TYPE_CHECKING:
    from datetime import datetime

    from sliplab.flows.status import CampaignStatus, StoreStatus
    from sliplab.storage.trials.store import TrialStore

app = typer.Typer()

EVERY_S = 5.0
"""Period of `status --watch`, s."""
LINES = 40
"""Entries of the log that are printed without --all."""


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab status my-store --watch")
def status(
    store: StoreArgument,
    watch: Annotated[
        bool, typer.Option("--watch", help="Print it again whenever it changes, until Ctrl-C.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Show who collects, how far each campaign is, when it ends, and what needs a person."""
    from sliplab.flows.running import stopping
    from sliplab.flows.status import StatusReader
    from sliplab.storage.trials.store import TrialStore

    if watch and as_json:
        raise InputError("--watch", "", "--json", "cannot be combined: --json prints one object")
    reader = StatusReader(TrialStore.open(store))
    found = reader.read()
    if as_json:
        console.print_json(vars(found))
        return
    _print(found)
    while watch:
        stopping.wait(EVERY_S)
        shown, found = state_lines(found), reader.read()
        if state_lines(found) != shown:
            _print(found)


@app.command(
    rich_help_panel=COLLECT, epilog='Example: sliplab log my-store "lens cleaned" --skin 0043'
)
def log(
    store: StoreArgument,
    text: Annotated[
        str | None, typer.Argument(help="A note to add; without it, the log is printed.")
    ] = None,
    skin: Annotated[
        str | None, typer.Option("--skin", help="Serial number of a skin that was mounted.")
    ] = None,
    context: Annotated[
        list[str] | None,
        typer.Option(
            "--context", help="Another value from now on: temperature='24 degC'. Repeatable."
        ),
    ] = None,
    campaign: CampaignOption = None,
    who: Annotated[
        str | None, typer.Option("--who", help="Your name; default: the login name.")
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help=f"Print all entries, not only the last {LINES}.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Print who did what and when; or add a note, or a skin or value that holds from now on.

    Both may be added while trials are taken: every trial from the next one on is stored with them.
    """
    from sliplab.flows.log import log_entries
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    changed = _pairs([*(context or []), *([] if skin is None else [f"skin={skin}"])])
    if text is not None or changed:
        _add(opened, text, changed, campaign, who, as_json)
        return
    if who is not None:
        raise InputError("--who", "", who, "is valid only with a note, --skin or --context")
    there = [item.name for item in opened.campaigns()]
    for name in campaign or ():
        if name not in there:
            right = one_of(name, there) if there else "is not there: no campaign has begun"
            raise InputError("--campaign", "", name, right)
    unreadable: list[str] = []
    entries = log_entries(opened, unreadable)
    if campaign:
        entries = [e for e in entries if {*e.campaign.split(", ")} & {*campaign}]
    for problem in unreadable:
        console.say(f"left out: {problem}")
    if as_json:
        console.print_json({"entries": [vars(item) for item in entries], "unreadable": unreadable})
        return
    shown = entries if everything else entries[-LINES:]
    rows = [
        [_local(e.when), e.who or None, e.what, e.campaign or None, ", ".join(e.trials), e.text]
        for e in shown
    ]
    columns = ["when", "who", "what", "campaign", "trials", "text"]
    console.print_table(f"log of {store}", columns, rows)
    if len(shown) < len(entries):
        console.say(f"the last {LINES} of {len(entries)} entries; --all prints them")


def _pairs(texts: list[str]) -> dict[str, str]:
    """Return NAME=VALUE options as a mapping. Raises InputError."""
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals:
            raise InputError("--context", "", text, "must be NAME=VALUE, such as operator=anna")
        if name.strip() in found:
            raise InputError("--context", "", text, f"gives {name.strip()} twice; give it once")
        found[name.strip()] = value.strip()
    return found


def _add(
    store: TrialStore,
    text: str | None,
    context: dict[str, str],
    campaigns: list[str] | None,
    who: str | None,
    as_json: bool,
) -> None:
    """Add a note or a change to the log, and print what a new skin asks for."""
    from sliplab.flows.log import add_note
    from sliplab.flows.status import StatusReader

    if who is not None and not who.strip():
        raise InputError("--who", "", who, "must be a name; leave it out for the login name")
    if campaigns and not context:
        raise InputError("--campaign", "", ", ".join(campaigns), "needs --skin or --context")
    entry = add_note(
        store, text or "", who=who or "", context=context, campaigns=campaigns, argument="TEXT"
    )
    repeat = {}
    if "skin" in context:
        found = StatusReader(store).read().campaigns
        repeat = {each.campaign: each.repeat for each in found if each.repeat}
    if as_json:
        console.print_json({**vars(entry), "repeat": repeat})
        return
    console.show(f"{entry.text if context else 'noted'} by {entry.who}, {_local(entry.when)}")
    for name, items in repeat.items():
        console.show(f"{name}: to do before its next trial, or with it")
        for item in items:
            console.show(f"  - {item}")


def _print(status: StoreStatus) -> None:
    for line in state_lines(status):
        console.show(line)


def state_lines(status: StoreStatus) -> list[str]:
    """Return the state in words, a line each."""
    from sliplab.protocols.shown import plural

    if status.running is None:
        lines = [f"{status.store}: nothing runs"]
    elif status.collects:
        lines = [f"{status.store}: collects {status.collects} ({status.running})"]
    else:
        lines = [f"{status.store}: in use by {status.running}"]
    if status.paused:
        lines.append(f"paused: {status.paused}; continue with `sliplab resume {status.store}`")
    for item in status.campaigns:
        lines += ["", *_campaign_lines(item)]
    if status.imported:
        lines += ["", f"{plural(len(status.imported), 'imported campaign')} without a plan"]
    if not status.campaigns and not status.imported:
        lines.append("no campaign yet: `sliplab collect` begins one")
    return lines


def _campaign_lines(item: CampaignStatus) -> list[str]:
    from sliplab.protocols.shown import plural

    simulated = " (simulated)" if item.simulated else ""
    if item.problem is not None:
        return [f"{item.campaign}{simulated}: cannot be read: {item.problem}"]
    lines = [
        f"{item.campaign}{simulated}: {item.committed} of {plural(item.planned, 'trial')}, "
        f"{item.missing} missing, {len(item.excluded)} excluded"
    ]
    if item.nights:
        tonight = f", {plural(item.tonight, 'trial')} in the current one" if item.tonight else ""
        lines.append(f"  nights    {item.nights} so far{tonight}; {_ends(item)}")
    if item.seconds_left:
        lines.append(f"  rig time  {console.duration(item.seconds_left)} left at the pace so far")
    if item.last_ended:
        lines.append(f"  last      trial committed {_local(item.last_ended)}")
    if item.missing and item.nights_of_disk is not None and item.bytes_per_trial is not None:
        needed = item.bytes_per_trial * item.missing
        lines.append(
            f"  disk      room for {item.nights_of_disk:,.0f} nights; the missing trials need "
            f"{console.size(needed)}"
        )
    for drift in item.drift:
        over = " (TOO MUCH)" if drift.reaches() else ""
        change = "not known" if drift.percent is None else f"{drift.percent:+.1f} %"
        lines.append(
            f"  drift     {drift.key} {change} since the first reference trial, "
            f"{drift.bound_percent:g} % allowed{over}"
        )
    if item.context:
        values = ", ".join(f"{name} {value}" for name, value in item.context.items())
        taken = ", ".join(f"{plural(n, 'trial')} with {skin}" for skin, n in item.skins.items())
        lines.append(f"  context   {values}{f' ({taken})' if taken else ''}")
    lines += [f"  to do     {each}" for each in item.repeat]
    for trial in item.excluded:
        by = f"by {trial['by']}" if trial["by"] else f"after {plural(trial['attempts'], 'attempt')}"
        lines.append(f"  excluded  {trial['trial']} {by}: {trial['cause']}")
    return lines


def _ends(item: CampaignStatus) -> str:
    from sliplab.protocols.shown import plural

    left = item.nights_left
    if not item.missing:
        return "complete"
    if left is None:
        return "no estimate of its end yet"
    more = f"about {plural(left.expected, 'more night')}"
    if left.low is None:
        return f"{more}, until {left.first}, if they are like those so far"
    if left.high is None:
        return f"{more}, at least {left.low}: nights differ much"
    dates = left.first if left.first == left.last else f"{left.first} to {left.last}"
    return f"{more} ({left.low} to {left.high}), the last on {dates}"


def _local(moment: str) -> str:
    from datetime import datetime

    found: datetime = datetime.fromisoformat(moment).astimezone()
    return f"{found:%Y-%m-%d %H:%M}"
