"""`sliplab new driver`: a package of one's own, to start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import PLAN, JsonOption, finish
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of

app = typer.Typer()
new_app = typer.Typer(
    help="Write a package to start from.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.add_typer(new_app, name="new", rich_help_panel=PLAN)


@new_app.callback()
def new() -> None:
    """Write a package to start from."""


@new_app.command("driver", epilog="Example: sliplab new driver my_arm --kind arm")
def driver(
    name: Annotated[
        str, typer.Argument(help="Name of the driver, as rig files will write it: my_arm.")
    ],
    kind: Annotated[
        str,
        typer.Option(
            "--kind",
            help="Kinds of device, with commas: arm, events, frames, sync, force, gripper, scalar.",
        ),
    ] = "arm",
    into: Annotated[
        Path, typer.Option("--into", help="Folder in which the package's own folder is made.")
    ] = Path(),
    as_json: JsonOption = False,
) -> None:
    """Write a package with a driver that works on its fake, and a test of SlipLab's rules."""
    from sliplab.plugins.driver_kit.new_package import (
        KINDS,
        driver_names,
        name_fault,
        write_package,
    )

    kinds = [part.strip() for part in kind.split(",")]
    for one in kinds:
        if one not in KINDS:
            raise InputError("--kind", "", one, one_of(one, KINDS))
        if kinds.count(one) > 1:
            raise InputError("--kind", "", kind, f"must name {one} once")
    drivers = driver_names(name, kinds)
    for driver_name in drivers:
        if fault := name_fault(driver_name):
            raise InputError("NAME", "", driver_name, fault)
    folder = into / name.replace("_", "-")
    if folder.exists():
        raise InputError("FOLDER", "", folder, "exists already and is not overwritten")
    try:
        written = write_package(folder, name, kinds)
    except OSError as error:
        text = f"cannot be written: {error.strerror}"
        raise InputError("FOLDER", "", folder, text) from None
    result = {"driver": ", ".join(drivers), "kind": kind, "folder": str(folder), "files": written}
    finish(result, f"new driver {name}", as_json)
