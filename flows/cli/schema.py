"""`sliplab schema`: what an editor needs to complete and check protocol and rig files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption, finish
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

app = typer.Typer()

KINDS = ("protocol", "rig")


@app.command()
def schema(
    kind: Annotated[str, typer.Argument(help="Of which file: protocol or rig.")],
    out: Annotated[
        Path | None, typer.Option("--out", help="Write it into this file instead.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the JSON Schema of a protocol or rig file."""
    if kind not in KINDS:
        raise InputError("KIND", "", kind, f"must be one of {', '.join(KINDS)}")
    from sliplab.flows.planning.schema import file_schema
    from sliplab.storage.files import write_json

    made = file_schema("protocol" if kind == "protocol" else "rig")
    if out is None:
        console.print_json(made)
        return
    write_json(out, made)
    finish({"kind": kind, "file": str(out)}, f"schema {kind}", as_json)
