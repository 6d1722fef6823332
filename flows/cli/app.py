"""The assembled command line. Heavy libraries are imported inside the commands that use them."""

from __future__ import annotations

from typing import Annotated

import typer

from sliplab.flows.cli import (
    bench,
    collect,
    control,
    detect,
    exchange,
    new,
    power,
    publish,
    reflex,
    register,
    review,
    rigs,
    schema,
    steps,
    store,
    stress,
    study,
    sweeps,
    twin,
)
from sliplab.flows.running import console

app = typer.Typer(
    name="sliplab",
    help="Run tactile slip experiments: plan, collect, sync, label, train, evaluate, report.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        from importlib.metadata import version

        console.show(f"sliplab {version('sliplab')}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Run tactile slip experiments: plan, collect, sync, label, train, evaluate, report."""


for part in (
    collect.app,
    register.app,
    power.app,
    steps.app,
    sweeps.app,
    bench.app,
    study.app,
    stress.app,
    store.app,
    rigs.app,
    control.app,
    exchange.app,
    publish.app,
    review.app,
    detect.app,
    reflex.app,
    schema.app,
    new.app,
):
    app.add_typer(part)
rigs.calibrate_app.add_typer(twin.app)
