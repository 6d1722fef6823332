"""`sliplab export`: trials, stores and networks in forms of other programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import Field

from sliplab.flows.cli.common import DATA, JsonOption, finish
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError
from sliplab.protocols.yaml_file import StrictModel

if TYPE_CHECKING:
    from sliplab.flows.exports import ExportRequest

app = typer.Typer()


class ExportOptions(StrictModel):
    """Options of the forms; each form takes some of them."""

    campaign: list[str] = Field(default=[], description="Only this campaign. Repeatable.")
    title: str | None = Field(
        default=None, description="Store: title; default: the campaigns' names."
    )
    creator: list[str] = Field(default=[], description="Store: name of an author. Repeatable.")
    licence: str | None = Field(
        default=None, description="Store: SPDX id of the licence, such as CC-BY-4.0."
    )
    stream: str | None = Field(
        default=None,
        description="Trials: an event camera's stream by its name; samples: any other one (force).",
    )
    store: Path | None = Field(
        default=None, description="Model: store of the test windows; default: the model's own."
    )
    windows: int | None = Field(
        default=None, ge=1, le=1_000_000, description="Model: windows to check ONNX on (256)."
    )


@app.command(
    rich_help_panel=DATA, epilog="Example: sliplab export my-store my-campaign --as dsec -o out"
)
@model_options
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
            "store: croissant, archive, mcap or lerobot. Of a model: onnx or card. Plug-ins add "
            "others.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", help="Folder to write, or file for labels and samples."),
    ] = ...,  # type: ignore[assignment]  # typer's word for: must be given
    options: ExportOptions = ExportOptions(),
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
    given = options.model_dump(exclude_unset=True)
    write(ExportRequest(place, part, form, output, given), as_json)


def write(request: ExportRequest, as_json: bool) -> None:
    """Run an export and print its result."""
    from sliplab.flows.exports import export as run

    done = run(request)
    finish(done.result if as_json or done.pairs is None else done.pairs, done.title, as_json)


def former(name: str, request: ExportRequest, as_json: bool) -> None:
    """Run an export by its former command, with a hint at its new form."""
    console.say(
        f"`{name}` is an old name; write: sliplab export {request.place} --as {request.form} "
        f"--output {request.output}"
    )
    write(request, as_json)
