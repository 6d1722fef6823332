"""`sliplab push` and `pull`: trials to shared or object storage, and back."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption, StoreArgument
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.storage.trials.store import Campaign, Store

UrlArgument = Annotated[
    str, typer.Argument(help="Where pushed stores are: s3://bucket/folder, file:///shared/folder.")
]
QuarantineOption = Annotated[
    bool, typer.Option("--quarantine", help="Also what was set aside, with its causes.")
]
FOLLOW_S = 30.0
"""How long `push --follow` waits before it looks again, s."""


def push(
    store: StoreArgument,
    url: UrlArgument,
    campaign: CampaignOption = None,
    quarantine: QuarantineOption = False,
    follow: Annotated[
        bool, typer.Option("--follow", help="Go on until the collection that runs has ended.")
    ] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Read what is there, and send anew what is damaged.")
    ] = False,
    sizes_only: Annotated[
        bool, typer.Option("--sizes-only", help="Do not read back what was sent.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Also trials of which there is another store's take.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Send committed trials to shared or object storage; run it again to send what is new.

    It may run while trials are taken. Keys and addresses of servers come from the environment.
    """
    from sliplab.flows.collecting.halting import holder_of
    from sliplab.flows.running import stopping
    from sliplab.storage.objects import Remote
    from sliplab.storage.remote.push import PushOptions
    from sliplab.storage.remote.push import push as send
    from sliplab.storage.trials.store import Store

    opened = Store.open(store)
    chosen = _chosen(opened, campaign)
    remote = Remote(url)
    wishes = PushOptions(quarantine, replace, not sizes_only, check)
    done = None
    while True:
        collects = follow and _collects(holder_of(store))
        total = sum(len(item.committed()) for item in chosen)
        with console.bar(f"push {store} (trials)", total) as bar:
            now = send(
                opened, remote, chosen, wishes,
                lambda name: bar.advance(1, name), lambda _: stopping.check(),
            )  # fmt: skip
        if done is None:
            done = now
        else:
            done.add(now)
        if not collects:
            break
        stopping.wait(FOLLOW_S)
    _finish({"url": remote.url, "simulated": opened.simulated, **vars(done)}, "push", as_json)


def pull(
    url: UrlArgument,
    store: Annotated[Path, typer.Argument(help="The store's folder; made if missing.")],
    campaign: CampaignOption = None,
    quarantine: QuarantineOption = False,
    as_json: JsonOption = False,
) -> None:
    """Bring pushed trials into a store, each checked; run it again to bring what is new."""
    from sliplab.storage.objects import Remote
    from sliplab.storage.remote.pull import pull as pull_trials

    with console.bar(f"pull {url} (trials)", 0) as bar:

        def seen(name: str) -> None:
            bar.extend(1)
            bar.advance(1, name)

        done = pull_trials(
            Remote(url), store, campaigns=campaign, quarantine=quarantine, on_trial=seen,
            on_bytes=lambda _: bar.advance(0),
        )  # fmt: skip
    _finish({"url": url, "store": str(store), **vars(done)}, "pull", as_json)


def verify_pushed(url: str, quarantine: bool, as_json: bool) -> None:
    """`sliplab verify` on a URL: everything there is read.

    Raises:
        InputError: something was to be set aside there.
    """
    from sliplab.flows.running import stopping
    from sliplab.storage.objects import Remote
    from sliplab.storage.remote.verify import verify_remote

    if quarantine:
        raise InputError(
            "--quarantine", "", url, "must not be given with a URL: `sliplab push --check` from a "
            "whole store sends anew what is damaged there",
        )  # fmt: skip
    with console.bar(f"verify {url} (trials)", 0) as bar:

        def seen(name: str) -> None:
            bar.extend(1)
            bar.advance(1, name)

        trials, problems = verify_remote(Remote(url), seen, lambda _: stopping.check())
    damaged = len({(item.campaign, item.trial) for item in problems if item.trial})
    if as_json:
        console.print_json(
            {
                "url": url,
                "trials": trials,
                "whole": trials - damaged,
                "damaged": damaged,
                "ok": not problems,
                "problems": [vars(item) for item in problems],
            }
        )
    elif problems:
        rows = [[item.path, item.what] for item in problems]
        console.print_table(f"{len(problems)} problems", ["where", "what is wrong"], rows)
    else:
        console.show(f"{trials} trials, all as they were committed")
    if problems:
        raise typer.Exit(console.FAILED)


def _chosen(store: Store, names: list[str] | None) -> list[Campaign]:
    there = {campaign.name: campaign for campaign in store.campaigns()}
    for name in names or ():
        if name not in there:
            text = f"is not in {store.folder}; there are {', '.join(there)}"
            raise InputError("--campaign", "", name, text)
    return [there[name] for name in (names or there)]


def _collects(holder: dict[str, Any] | None) -> bool:
    return bool(holder and holder.get("collects"))


def _finish(result: dict[str, Any], what: str, as_json: bool) -> None:
    """Print what was done; problems end the program with exit 1."""
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
        raise typer.Exit(console.FAILED)


def register(app: typer.Typer) -> None:
    """Make them commands of `app`."""
    for command in (push, pull):
        app.command()(command)
