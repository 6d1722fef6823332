"""`sliplab plan`, `check` and `collect`: from a protocol to committed trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import (
    COLLECT,
    PLAN,
    EnableOption,
    JsonOption,
    ProtocolArgument,
    RigOption,
    StoreOption,
    finish,
)
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.planning.parameters import CollectOptions
from sliplab.flows.running import console, exit_codes
from sliplab.flows.steps import prepare_store

app = typer.Typer()


@app.command(rich_help_panel=PLAN, epilog="Example: sliplab plan kinematic --rig mock")
def plan(
    protocol: ProtocolArgument,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="A rig file or name, to estimate bytes.")
    ] = None,
    pilot: Annotated[
        Path | None,
        typer.Option(
            "--pilot",
            help="Folder of a store with labelled trials, to predict when the protocol's claims "
            "end the campaign.",
        ),
    ] = None,
    enable: EnableOption = None,
    as_json: JsonOption = False,
) -> None:
    """Print the trials in the order of collection, with the time and (given a rig) bytes needed."""
    from sliplab.flows.planning import plan_view
    from sliplab.protocols.plan import load_plan

    found = load_plan(protocol, enable or (), True)
    needed, scene = None, None
    if rig is not None:
        from sliplab.flows.planning.size_estimate import plan_bytes
        from sliplab.rigs.rig_file import check_plan, load_rig_file

        rig_file, _ = load_rig_file(rig)
        check_plan(rig_file, found, str(rig))
        needed = round(plan_bytes(rig_file, found))
        scene = plan_view.scene_of(rig_file, found)
    claims = None
    if pilot is not None:
        from sliplab.storage.remote.mirror import open_store

        opened = open_store(pilot)
        prepare_store(pilot)  # before anything imports Prefect
        from sliplab.protocols.plugin import plugins

        claims = plugins().hook("forecast")(found, opened)
    if as_json:
        console.print_json(plan_view.plan_json(found, needed, scene, claims))
    else:
        plan_view.print_plan(found, needed, scene, claims)


@app.command(
    rich_help_panel=PLAN, epilog="Example: sliplab check pilot --rig mock --store my-store"
)
def check(
    protocol: ProtocolArgument,
    rig: RigOption,
    store: StoreOption,
    enable: EnableOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check everything that can be checked before anything moves."""
    from sliplab.flows.planning import preflight

    found = preflight.check(protocol, rig, store, tuple(enable or ()))
    if as_json:
        console.print_json(preflight.checks_json(found))
    else:
        stated = ["FAILED" if not it.passed else "note" if it.caution else "ok" for it in found]
        rows = [[word, it.name, it.finding] for word, it in zip(stated, found, strict=True)]
        console.print_table(f"check {protocol} on {rig}", ["", "what", "found"], rows)
    if not all(item.passed for item in found):
        raise typer.Exit(exit_codes.FAILED)


@app.command(
    rich_help_panel=COLLECT, epilog="Example: sliplab collect pilot --rig mock --store my-store"
)
@model_options
def collect(
    protocol: ProtocolArgument,
    rig: RigOption,
    store: StoreOption,
    options: CollectOptions,
    as_json: JsonOption = False,
) -> None:
    """Collect the missing trials. Ctrl-C stops the arm; run the same command to resume."""
    from sliplab.flows.planning.run_request import check_disk, make_request
    from sliplab.flows.register import registration_line
    from sliplab.flows.running import orchestration
    from sliplab.storage.trials.store import TrialStore

    run_request = make_request(protocol, rig, store, **options.arguments())
    for warning in run_request.plan.warnings():
        console.say(f"note: {warning}")
    console.say(
        registration_line(TrialStore(store).campaign(run_request.campaign), run_request.plan)
    )
    check_disk([run_request])
    prepare_store(store)
    if run_request.due_trials(TrialStore(store).campaign(run_request.campaign)):
        orchestration.start_server()  # starts while the imports below load
    from sliplab.flows.collect import collect as collect_trials

    result = collect_trials(run_request)
    if not result["taken"]:
        console.say(
            "nothing to do: all available trials are collected"
            if not result["left_out"]
            else "nothing to do: the campaign ended by its claims; --no-stopping continues"
        )
    if not as_json:
        from sliplab.flows.planning.campaign_trials import print_excluded

        print_excluded(result["causes"])
    shown = {key: value for key, value in result.items() if as_json or key != "causes"}
    finish(shown, f"collected into {store}", as_json)
    if result["missing"] > result["left_out"]:
        raise typer.Exit(exit_codes.FAILED)
