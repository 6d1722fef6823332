"""`sliplab schema`: JSON Schemas of protocols, rig files, adapters and documents in a store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from sliplab.flows.cli.common import JsonOption, finish
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.flows.planning.schema import Kind

app = typer.Typer()

KINDS = (
    "protocol", "rig", "adapter", "trial", "label", "evaluation", "summary", "classes",
    "classes-summary", "twin", "drift", "gap", "power", "stress", "reflex", "bench",
)  # fmt: skip


@app.command()
def schema(
    kind: Annotated[str, typer.Argument(help=f"Kind of file: {', '.join(KINDS)}.")],
    out: Annotated[Path | None, typer.Option("--out", help="Write to this file instead.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the JSON Schema of a protocol, a rig file, an adapter or a document in a store."""
    if kind not in KINDS:
        raise InputError("KIND", "", kind, f"must be one of {', '.join(KINDS)}")
    from sliplab.flows.planning.schema import file_schema
    from sliplab.storage.files import write_json

    made = file_schema(cast("Kind", kind))
    if out is None:
        console.print_json(made)
        return
    write_json(out, made)
    finish({"kind": kind, "file": str(out)}, f"schema {kind}", as_json)
