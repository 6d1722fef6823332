"""`sliplab reflex`: drops that reflexes prevent on a simulated rig."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption
from sliplab.flows.running import console

app = typer.Typer()


@app.command(epilog="Example: sliplab reflex my-study --rig mock_gripper")
def reflex(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL|STORE",
            help="A trained network, or a store with all its detectors.",
        ),
    ],
    rig: Annotated[
        Path, typer.Option("--rig", help="A simulated rig: a rig file (YAML), or a name.")
    ] = Path("mock-gripper"),
    protocol: Annotated[
        Path, typer.Option("--protocol", help="Gravity trials (YAML); default: reflex.")
    ] = Path("reflex"),
    reflexes: Annotated[
        list[str] | None,
        typer.Option(
            "--reflex",
            help="stop, press:MM or grip:MM. Repeatable. Default: stop, press:0.4, and grip:0.4 "
            "on a rig with a gripper.",
        ),
    ] = None,
    detectors: Annotated[
        list[str] | None,
        typer.Option(
            "--detector",
            help="Of a store: network or paper (with the rule), or another. Repeatable. Default: "
            "all.",
        ),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=10_000, help="Trials of each condition.")
    ] = 1,
    out: Annotated[Path, typer.Option("--out", help="Folder for the page and its numbers.")] = Path(
        "sliplab-reflex"
    ),
    as_json: JsonOption = False,
) -> None:
    """Run trials with and without reflexes: drops prevented, way fallen, force, reaction time."""
    if model.is_dir():
        from sliplab.flows.steps import prepare_store
        from sliplab.storage.remote.mirror import open_store

        open_store(model)
        prepare_store(model)  # before anything imports Prefect
    from sliplab.plugins.reflex.page import COLUMNS, cells
    from sliplab.plugins.reflex.study import measure_reflexes, request

    study = measure_reflexes(
        request(model, rig, out, protocol, reflexes or (), trials, detectors or ())
    )
    page = out / "reflex.html"
    if as_json:
        console.print_json({"page": str(page), **study.to_json()})
        return
    console.print_table("reflexes, simulated", COLUMNS, [cells(row) for row in study.rows])
    console.say(f"page: {page}")
