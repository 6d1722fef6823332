"""`sliplab export`: trials, stores and networks in forms of other programs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import DATA, JsonOption, finish, located
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.flows.exports import ExportRequest

app = typer.Typer()


@app.command(
    rich_help_panel=DATA, epilog="Example: sliplab export my-store my-campaign --as dsec -o out"
)
def export(
    place: Annotated[
        str, typer.Argument(metavar="WHAT", help="A store's folder or URL, or a model's file.")
    ],
    part: Annotated[
        str,
        typer.Argument(
            metavar="PART", help="A campaign or a trial of the store.", show_default=False
        ),
    ] = "",
    form: Annotated[
        str | None,
        typer.Option(
            "--as",
            help="Form. Of PART: aedat4, dsec, or labels or samples (.csv, .parquet, .json). Of a "
            "store: croissant, mcap or lerobot. Of a model: onnx or card. Plug-ins add others.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder to write, or file for labels and samples."),
    ] = ...,  # type: ignore[assignment]  # typer's word for: must be given
    campaign: Annotated[
        list[str] | None,
        typer.Option("--campaign", help="Store, model: only this campaign. Repeatable."),
    ] = None,
    title: Annotated[
        str | None, typer.Option("--title", help="Store: title; default: the campaigns' names.")
    ] = None,
    creator: Annotated[
        list[str] | None, typer.Option("--creator", help="Store: name of an author. Repeatable.")
    ] = None,
    licence: Annotated[
        str | None,
        typer.Option("--licence", help="Store: SPDX id of the licence, such as CC-BY-4.0."),
    ] = None,
    stream: Annotated[
        str | None,
        typer.Option(
            "--stream",
            help="Trials: an event camera's stream by its name; samples: any other one (force).",
        ),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option("--store", help="Model: store of the test windows; default: the model's own."),
    ] = None,
    windows: Annotated[
        int | None,
        typer.Option(
            "--windows", min=1, max=1_000_000, help="Model: windows to check ONNX on (256)."
        ),
    ] = None,
    old_form: Annotated[str | None, typer.Option("--format", hidden=True)] = None,
    old_labels: Annotated[bool, typer.Option("--labels", hidden=True)] = False,
    as_json: JsonOption = False,
) -> None:
    """Export trials, a store or a network in a form of other programs."""
    from sliplab.flows.exports import ExportRequest, fitting_forms

    if form is None and part:
        form = "labels" if old_labels else old_form or "aedat4"
        console.say(
            f"without --as is an old form; write: sliplab export {place} {part} --as {form} "
            f"--output {output}"
        )
    if form is None:
        raise InputError("--as", "", None, f"is needed: {fitting_forms(place)}")
    given = {
        "campaign": campaign,
        "title": title,
        "creator": creator,
        "licence": licence,
        "stream": stream,
        "store": store,
        "windows": windows,
    }
    options = {name: value for name, value in given.items() if value is not None}
    write(ExportRequest(place, part, form, output, options), as_json)


def write(request: ExportRequest, as_json: bool) -> None:
    """Run an export and print its result."""
    from sliplab.flows.exports import check_export

    form = check_export(request)
    if form.of != "model":
        request = replace(request, place=str(located(request.place)))
    done = form.write(request)
    finish(done.result if as_json or done.pairs is None else done.pairs, done.title, as_json)


def former(name: str, request: ExportRequest, as_json: bool) -> None:
    """Run an export by its former command, with a hint at its new form."""
    console.say(
        f"`{name}` is an old name; write: sliplab export {request.place} --as {request.form} "
        f"--output {request.output}"
    )
    write(request, as_json)
