"""`sliplab import`: files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import (
    DATA,
    FAULTS,
    JsonOption,
    StoreOption,
    finish,
    new_store,
    path_only,
    say_faults,
)
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import one_of

app = typer.Typer()


@app.command(
    "import",
    rich_help_panel=DATA,
    epilog="Example: sliplab import recordings --store my-store --name old",
)
def import_(
    kind_or_path: Annotated[
        str,
        typer.Argument(
            metavar="KIND|PATH", help="A file, or a folder of files; or their KIND, before PATH."
        ),
    ],
    path: Annotated[
        Path | None,
        typer.Argument(metavar="PATH", help="The file or folder after KIND.", show_default=False),
    ] = None,
    store: StoreOption = ...,  # type: ignore[assignment]  # typer's word for: must be given
    name: Annotated[
        str | None,
        typer.Option("--name", help="Name of the new campaign; by default the adapter's."),
    ] = None,
    adapter: Annotated[
        Path | None,
        typer.Option("--adapter", help="Adapter (YAML) of a data set with labels and factors."),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="With --adapter: list what would be imported."),
    ] = False,
    simulated: Annotated[
        bool, typer.Option("--simulated", help="Mark the trials as simulated.")
    ] = False,
    salvage: Annotated[
        bool,
        typer.Option("--salvage", help="Import the undamaged beginning of a damaged file."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Import recordings of other programs into a new campaign; unknown values are marked.

    KIND is aedat4, dsec, lab-hdf5, lab-pickles, mcap, rosbag, raw, es, croissant or lerobot; by
    default the content decides, for each file of a folder. --adapter imports a data set with its
    labels and factors, from a folder or .zip, as a campaign to train and evaluate on
    (docs/adapters.md).
    """
    for given_path in (path, Path(kind_or_path)):
        path_only("PATH")(given_path)
    if adapter is not None:
        for option, given in (("KIND", path is not None), ("--simulated", simulated)):
            if given:
                raise InputError(option, "", None, "cannot be given with --adapter")
        from sliplab.flows.cli.adapted import import_by_adapter

        import_by_adapter(
            adapter,
            Path(kind_or_path),
            store,
            name,
            salvage=salvage,
            dry_run=dry_run,
            as_json=as_json,
        )
        return
    if dry_run:
        raise InputError("--dry-run", "", None, "is for an import with --adapter")
    if name is None:
        raise InputError("--name", "", None, "is missing: the name of the new campaign")
    from dataclasses import replace

    from sliplab.flows.collecting.requests import store_lock
    from sliplab.storage.files import safe_name
    from sliplab.storage.formats.import_trials import import_trials
    from sliplab.storage.formats.known import format_names
    from sliplab.storage.formats.recognition import entered, kind_of, skipped_in, trials_in
    from sliplab.storage.trials.store import StoreError

    where = entered(Path(kind_or_path) if path is None else path)
    kind = kind_of(where) if path is None else kind_or_path
    if path is not None and kind not in format_names():
        raise InputError("KIND", "", kind, one_of(kind, format_names()))
    try:
        safe_name(name)
    except StoreError as error:
        raise InputError("--name", "", name, str(error)) from None
    skipped = skipped_in(where, kind)
    found = trials_in(where, kind, salvage=salvage)
    if simulated:
        found = (replace(trial, simulated=True) for trial in found)
    with new_store(store) as opened, store_lock(opened):
        result = import_trials(
            opened, name, found, where, kind, lambda trial: console.say(trial), salvage=salvage
        )
    say_faults(result)
    for item in skipped:
        console.say(f"skipped: {item.file}: {item.reason}")
    if skipped:
        result["skipped"] = [vars(item) for item in skipped]
    failed = "failed" in result
    if not as_json:
        for key in (*FAULTS, "skipped"):
            result.pop(key, None)
    finish(result, f"imported into {store}", as_json)
    if failed:
        raise typer.Exit(exit_codes.FAILED)
