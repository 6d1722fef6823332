"""`sliplab pause`, `resume`, `stop`, `skip`, `again`, `serve`: control from another process.

Those before `serve` are for another terminal: each request is stored in STORE/control/ with its
user, time and reason. `serve` offers one rig's deployments, with schedules, on a page.
"""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import COLLECT, JsonOption, RigOption, StoreArgument, StoreOption
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.cli.page import PublicOption, origin
from sliplab.flows.planning.parameters import ControlOptions, Requester
from sliplab.flows.running import console, exit_codes
from sliplab.flows.steps import prepare_store
from sliplab.protocols.plugin import plugins

if TYPE_CHECKING:
    from sliplab.flows.collecting.requests import RequestOutcome
    from sliplab.storage.trials.control import Kind

app = typer.Typer()

RUNS = 3
"""Upcoming runs of each schedule that `serve --check` shows."""
_SHOWN = "%a %Y-%m-%d %H:%M %Z"

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
    """Stop a running collection at once, arm first, like Ctrl-C in its terminal."""
    from sliplab.flows.collecting.requests import halt
    from sliplab.storage.trials.store import Store

    opened = Store.open(store)
    halted = halt(store)  # before anything that takes long to load
    from sliplab.flows.collecting import requests

    outcome = requests.note_stop(opened, *halted, **wanted.arguments())
    words = "nothing ran" if outcome.holder is None else "stopped: every committed trial is kept"
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
    from sliplab.storage.trials.store import Store

    return requests.ask(Store.open(store), kind, **wanted.arguments())


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
    from sliplab.storage.trials.store import Store

    if not why.strip():
        raise InputError("--why", "", why, "must not be empty: it is stored with the trial")
    opened = Store.open(store)
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
    from sliplab.flows.server.schedules import has_alerts, load_schedules, upcoming_runs
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
            console.print_table(f"schedules of {schedules}", columns, rows)
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
    from sliplab.flows.server.serve import serve as run
    from sliplab.storage.trials.store import Store

    run(
        Store.open(store),
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
