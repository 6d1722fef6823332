"""`sliplab pause`, `resume`, `stop`, `skip`, `again`: control from another terminal.

Each request is stored in STORE/control/ with its user, time and reason.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, StoreArgument
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.planning.parameters import ControlOptions, Requester
from sliplab.flows.running import console, exit_codes

if TYPE_CHECKING:
    from sliplab.flows.collecting.requests import RequestOutcome
    from sliplab.storage.trials.control import Kind

app = typer.Typer()

TrialsArgument = Annotated[
    list[str], typer.Argument(help="Trial ids, as listed by `sliplab plan --json`.")
]
NeededWhyOption = Annotated[
    str, typer.Option("--why", help="The reason, stored with the trial.", show_default=False)
]
CampaignOption = Annotated[
    str | None, typer.Option("--campaign", help="The campaign, if several contain the trials.")
]


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab pause my-store")
@model_options
def pause(
    store: StoreArgument,
    wanted: ControlOptions,
    as_json: JsonOption = False,
) -> None:
    """Pause after the current trial; returns once the collection is paused."""
    outcome = _request(store, "pause", wanted)
    _finish([outcome], as_json, _pause_words(store, outcome))


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab resume my-store")
@model_options
def resume(
    store: StoreArgument,
    wanted: ControlOptions = ControlOptions(wait_s=60.0),
    as_json: JsonOption = False,
) -> None:
    """Resume a paused collection."""
    outcome = _request(store, "resume", wanted)
    running = outcome.answer is not None and outcome.answer["did"].get("running")
    words = f"{store} is no longer paused" + ("; the collection continues" if running else "")
    _finish([outcome], as_json, words)


@app.command(rich_help_panel=COLLECT, epilog="Example: sliplab stop my-store")
@model_options
def stop(
    store: StoreArgument,
    wanted: ControlOptions = ControlOptions(wait_s=60.0),
    as_json: JsonOption = False,
) -> None:
    """Stop a collection at once, arm first, like Ctrl-C; also one that starts or waits."""
    from sliplab.flows.collecting.requests import halt
    from sliplab.storage.trials.store import TrialStore

    opened = TrialStore.open(store)
    halted = halt(store)  # before anything that takes long to load
    from sliplab.flows.collecting import requests

    outcome = requests.note_stop(opened, *halted, **wanted.arguments())
    words = "stopped: every committed trial is kept"
    if outcome.holder is None:
        words = "nothing collects; a run that starts or waits now ends before the arm moves"
    _finish([outcome], as_json, words)


@app.command(
    rich_help_panel=COLLECT,
    epilog='Example: sliplab skip my-store TRIAL --why "the tip was worn"',
)
@model_options
def skip(
    store: StoreArgument,
    trials: TrialsArgument,
    why: NeededWhyOption,
    campaign: CampaignOption = None,
    requester: Requester = Requester(),
    as_json: JsonOption = False,
) -> None:
    """Skip trials: they are not collected until `sliplab again` requests them."""
    _decide(store, "skip", trials, campaign, why, requester, as_json)


@app.command(
    rich_help_panel=COLLECT,
    epilog='Example: sliplab again my-store TRIAL --why "the plate was dirty"',
)
@model_options
def again(
    store: StoreArgument,
    trials: TrialsArgument,
    why: NeededWhyOption,
    campaign: CampaignOption = None,
    requester: Requester = Requester(),
    as_json: JsonOption = False,
) -> None:
    """Retake trials: the committed recording is moved to quarantine, never deleted."""
    _decide(store, "again", trials, campaign, why, requester, as_json)


def _request(store: Path, kind: Kind, wanted: ControlOptions) -> RequestOutcome:
    from sliplab.flows.collecting import requests
    from sliplab.storage.trials.store import TrialStore

    return requests.ask(TrialStore.open(store), kind, **wanted.arguments())


def _decide(
    store: Path,
    kind: Kind,
    trials: list[str],
    campaign: str | None,
    why: str,
    requester: Requester,
    as_json: bool,
) -> None:
    from sliplab.flows.collecting import requests
    from sliplab.protocols.errors import InputError
    from sliplab.storage.trials.store import TrialStore

    if not why.strip():
        raise InputError("--why", "", why, "must not be empty: it is stored with the trial")
    opened = TrialStore.open(store)
    by_campaign = requests.known_trials(opened, [campaign] if campaign else None, trials)
    outcomes = [
        requests.ask(opened, kind, why=why, campaign=name, trials=ids, **requester.arguments())
        for name, ids in by_campaign.items()
    ]
    lines = [
        f"{trial}: {did}"
        for outcome in outcomes
        if outcome.answer is not None
        for trial, did in outcome.answer["did"].get("trials", {}).items()
    ]
    _finish(outcomes, as_json, "\n".join(lines))


def _pause_words(store: Path, outcome: RequestOutcome) -> str:
    did = {} if outcome.answer is None else outcome.answer["did"]
    if did.get("running"):
        return f"{store} is paused, between two trials; continue with `sliplab resume {store}`"
    return (
        f"{store} is paused; nothing was running, and nothing starts until `sliplab resume {store}`"
    )


def _finish(outcomes: list[RequestOutcome], as_json: bool, words: str) -> None:
    """Print the outcomes; exit 1 if a request is still open."""
    done = all(outcome.answer is not None for outcome in outcomes)
    if as_json:
        found = [outcome.as_json() for outcome in outcomes]
        console.print_json(found[0] if len(found) == 1 else {"done": done, "requests": found})
    elif done:
        console.show(words)
    if not done:
        kind = outcomes[0].request.kind
        console.say(
            f"not yet: the request stays open and is carried out when the trial that runs is over "
            f"({kind}, number {outcomes[0].request.number})"
        )
        raise typer.Exit(exit_codes.FAILED)
