"""`sliplab import`: files of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sliplab.flows.cli.common import DATA, JsonOption, StoreOption, finish
from sliplab.flows.running import console, exit_codes
from sliplab.protocols.errors import InputError

app = typer.Typer()

_SHOWN = 10


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
    watch: Annotated[
        bool,
        typer.Option("--watch", help="Import files of a folder as their writer closes them."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Import recordings of other programs into a new campaign; unknown values are marked.

    KIND is aedat4, dsec, lab-hdf5, lab-pickles, mcap, rosbag, raw, es, croissant or lerobot; by
    default the content decides, for each file of a folder. --adapter imports a data set with its
    labels and factors, from a folder or .zip, as a campaign to train and evaluate on
    (docs/adapters.md).
    """
    from sliplab.flows.imports import import_data

    source = Path(kind_or_path) if path is None else path
    if watch:
        if adapter is not None or dry_run:
            raise InputError("--watch", "", None, "cannot be given with --adapter or --dry-run")
        from sliplab.flows.folder_watch import watch as run_watch

        kind = None if path is None else kind_or_path
        found = run_watch(source, store, name, kind, simulated=simulated, salvage=salvage)
        finish(found, f"imported into {store}", as_json)
        return
    result = import_data(
        source,
        store,
        kind=None if path is None else kind_or_path,
        name=name,
        adapter=adapter,
        dry_run=dry_run,
        simulated=simulated,
        salvage=salvage,
    )
    failed = "failed" in result
    title = f"{result['campaign']}: nothing was written" if dry_run else f"imported into {store}"
    if as_json:
        finish(result, title, True)
    else:
        _show(result, title, f"trials of {source}" if dry_run else "")
    if failed:
        raise typer.Exit(exit_codes.FAILED)


def _show(result: dict[str, Any], title: str, planned: str) -> None:
    """Print the result of an import for a person; its faults were printed when they were found.

    Args:
        planned: title of the table of what would be imported; empty after an import.
    """
    skipped, split = result.pop("skipped", []), result.pop("split", None)
    for key in ("warnings", "salvaged", "left_out", "failed"):
        result.pop(key, None)
    if planned:
        rows = result["trials"]
        cells = [
            (
                row["trial"],
                ", ".join(f"{factor} {level}" for factor, level in row["condition"].items()) or "-",
                row["label"] or "-",
                row["part"],
                "yes" if row["there"] else "no",
            )
            for row in rows
        ]
        columns = ("trial", "condition", "label", "part", "there")
        console.print_table(planned, columns, cells, limit=4 * _SHOWN)
        result["trials"] = len(rows)
    if split is not None:  # a data set by an adapter, which may skip thousands of files
        for item in skipped[:_SHOWN]:
            console.say(f"skipped: {item['file']}: {item['reason']}")
        if len(skipped) > _SHOWN:
            console.say(f"skipped: {len(skipped) - _SHOWN} more; --json lists all")
        result |= {key: len(result[key]) for key in ("imported", "there") if key in result}
        parts = ", ".join(f"{count} {part}" for part, count in split.items())
        result |= {"split": parts, "skipped": len(skipped)}
    finish(result, title, False)
