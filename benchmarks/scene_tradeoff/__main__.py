"""`python -m benchmarks.scene_tradeoff PROTOCOL`: cost and error of a scene's levels."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from benchmarks.command import run_command
from benchmarks.scene_tradeoff.page import choice_pairs, short_table
from benchmarks.scene_tradeoff.run import PAGE, tradeoff_scene
from sliplab.flows.cli.common import DaskOption, JsonOption, ProtocolArgument
from sliplab.flows.running import console


def main(
    protocol: ProtocolArgument,
    rig: Annotated[Path, typer.Option("--rig", help="A simulated rig: a file or a name.")] = Path(
        "mock"
    ),
    out: Annotated[Path, typer.Option("--out", help="Output folder.")] = Path("sliplab-tradeoff"),
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1_000_000, help="Trials to simulate.")
    ] = 4,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Also vary each assumed parameter.")
    ] = False,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Measure cost and error of each level of a simulated scene."""
    result = tradeoff_scene(protocol, rig, out, trials, sensitivity, dask=dask)
    if as_json:
        console.print_json(result)
        return
    title = f"Cost and error of the scene of {result['protocol']} (simulated)"
    console.print_table(title, *short_table(result))
    console.print_pairs("Required level of physics", choice_pairs(result))
    console.show(f"Page (simulated): {(out / PAGE).resolve()}")


app = typer.Typer()
app.command()(main)
run_command(app)
