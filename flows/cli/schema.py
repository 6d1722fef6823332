"""`sliplab schema`: JSON Schemas of protocols, rig files, adapters and documents in a store."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import PLAN, JsonOption, finish
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of

app = typer.Typer()


@app.command(
    rich_help_panel=PLAN, epilog="Example: sliplab schema protocol --out protocol.schema.json"
)
def schema(
    kind: Annotated[
        str | None,
        typer.Argument(
            help="Kind of file, such as protocol, rig or trial; without it, all are listed.",
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="Write to this file instead; without KIND, all to this folder. Missing folders "
            "are made.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Print the JSON Schema of a protocol, a rig file, an adapter or a document in a store."""
    from sliplab.flows.planning.json_schemas import file_schema, kinds
    from sliplab.storage.files import make_folder, write_json

    if kind is None and out is not None:
        _write_all(out, as_json)
        return
    if kind is None:
        if as_json:
            console.print_json({"kinds": kinds()})
        else:
            console.show("\n".join(kinds()))
        return
    if kind not in kinds():
        raise InputError("KIND", "", kind, one_of(kind, kinds()))
    made = file_schema(kind)
    if out is None:
        console.print_json(made)
        return
    from sliplab.storage.trials.catalogue import refuse_store_file

    refuse_store_file(out, "--out")
    make_folder(out.parent)
    write_json(out, made)
    finish({"kind": kind, "file": str(out)}, f"schema {kind}", as_json)


def _write_all(folder: Path, as_json: bool) -> None:
    """Write every schema as ``KIND.json``."""
    from sliplab.flows.planning.json_schemas import file_schema, kinds
    from sliplab.storage.files import make_folder, write_json
    from sliplab.storage.trials.catalogue import refuse_store_file

    if folder.suffix.lower() == ".json" or (folder.exists() and not folder.is_dir()):
        raise InputError("--out", "", str(folder), "must be a folder; one file needs a KIND")
    for kind in kinds():
        refuse_store_file(folder / f"{kind}.json", "--out")
    make_folder(folder)
    for kind in kinds():
        write_json(folder / f"{kind}.json", file_schema(kind))
    finish({"kinds": kinds(), "folder": str(folder)}, "schema", as_json)
