"""`sliplab pause`, `resume`, `stop`, `skip` and `again`: a campaign led from another terminal.

Each one keeps in STORE/control/ who asked for what, when and why.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.running import console

if TYPE_CHECKING:
    from sliplab.flows.collecting.controlling import Outcome
    from sliplab.storage.trials.control import Kind

StoreArgument = Annotated[Path, typer.Argument(help="A store's folder.")]
TrialsArgument = Annotated[list[str], typer.Argument(help="Ids of trials, as in `sliplab plan`.")]
WhyOption = Annotated[str, typer.Option("--why", help="The reason, kept with the request.")]
NeededWhyOption = Annotated[
    str, typer.Option("--why", help="The reason, kept with the trial.", show_default=False)
]
WhoOption = Annotated[str, typer.Option("--who", help="Who asks; the user's name by default.")]
WaitOption = Annotated[
    float, typer.Option("--wait", min=0, max=86400, help="How long to wait for it, s.")
]
CampaignOption = Annotated[
    str | None, typer.Option("--campaign", help="Whose trials, where several have them.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="One JSON object on standard output, the rest on error.")
]


def pause(
    store: StoreArgument, why: WhyOption = "", who: WhoOption = "", wait: WaitOption = 600.0,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Let the trial that runs come to its end, then stand still; returns when it stands still."""
    outcome = _request(store, "pause", who, why, wait)
    _finish([outcome], as_json, _pause_words(store, outcome))


def resume(
    store: StoreArgument, why: WhyOption = "", who: WhoOption = "", wait: WaitOption = 60.0,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Go on after a pause."""
    outcome = _request(store, "resume", who, why, wait)
    running = outcome.answer is not None and outcome.answer["did"].get("running")
    words = f"{store} is not paused any more" + ("; the collection goes on" if running else "")
    _finish([outcome], as_json, words)


def stop(
    store: StoreArgument, why: WhyOption = "", who: WhoOption = "", wait: WaitOption = 60.0,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Stop a running collection now, the arm first, as Ctrl-C in its terminal would."""
    from sliplab.flows.collecting.halting import halt
    from sliplab.storage.trials.store import Store

    opened = Store.open(store)
    halted = halt(store)  # before anything that takes long to load
    from sliplab.flows.collecting import controlling

    outcome = controlling.note_stop(opened, *halted, who=who, why=why, limit_s=wait)
    words = "nothing ran" if outcome.holder is None else "stopped: every committed trial is kept"
    _finish([outcome], as_json, words)


def skip(
    store: StoreArgument, trials: TrialsArgument, why: NeededWhyOption,
    campaign: CampaignOption = None, who: WhoOption = "", wait: WaitOption = 600.0,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Set trials aside: no collection takes them until `sliplab again` asks for them."""
    _decide(store, "skip", trials, campaign, who, why, wait, as_json)


def again(
    store: StoreArgument, trials: TrialsArgument, why: NeededWhyOption,
    campaign: CampaignOption = None, who: WhoOption = "", wait: WaitOption = 600.0,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Take trials again: what is committed is moved to quarantine, never deleted."""
    _decide(store, "again", trials, campaign, who, why, wait, as_json)


def register(app: typer.Typer) -> None:
    """Add the commands to the command line."""
    for command in (pause, resume, stop, skip, again):
        app.command()(command)


def _request(store: Path, kind: Kind, who: str, why: str, wait: float) -> Outcome:
    from sliplab.flows.collecting import controlling
    from sliplab.storage.trials.store import Store

    return controlling.request(Store.open(store), kind, who=who, why=why, limit_s=wait)


def _decide(
    store: Path, kind: Kind, trials: list[str], campaign: str | None, who: str, why: str,
    wait: float, as_json: bool,
) -> None:  # fmt: skip
    from sliplab.flows.collecting import controlling
    from sliplab.protocols.errors import InputError
    from sliplab.storage.trials.store import Store

    if not why.strip():
        raise InputError("--why", "", why, "must say something: it is kept with the trial")
    opened = Store.open(store)
    by_campaign = controlling.known_trials(opened, [campaign] if campaign else None, trials)
    outcomes = [
        controlling.request(opened, kind, who=who, why=why, campaign=name, trials=ids, limit_s=wait)
        for name, ids in by_campaign.items()
    ]
    lines = [
        f"{trial}: {did}"
        for outcome in outcomes
        if outcome.answer is not None
        for trial, did in outcome.answer["did"].get("trials", {}).items()
    ]
    _finish(outcomes, as_json, "\n".join(lines))


def _pause_words(store: Path, outcome: Outcome) -> str:
    did = {} if outcome.answer is None else outcome.answer["did"]
    if did.get("running"):
        return f"{store} is paused, between two trials; `sliplab resume {store}` goes on"
    return f"{store} is paused; nothing ran, and nothing begins until `sliplab resume {store}`"


def _finish(outcomes: list[Outcome], as_json: bool, words: str) -> None:
    """Print what came of it; exit 1 while it is not done."""
    done = all(outcome.answer is not None for outcome in outcomes)
    if as_json:
        found = [outcome.as_json() for outcome in outcomes]
        console.print_json(found[0] if len(found) == 1 else {"done": done, "requests": found})
    elif done:
        console.show(words)
    if not done:
        kind = outcomes[0].request.kind
        console.say(
            f"not yet: the request stands and is carried out when the trial that runs is over "
            f"({kind}, number {outcomes[0].request.number})"
        )
        raise typer.Exit(console.FAILED)
