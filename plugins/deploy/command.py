"""`sliplab export MODEL --as onnx`: a trained network for other programs and chips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption
from sliplab.flows.cli.export import former
from sliplab.flows.exports import Export, ExportRequest, ExportResult
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.plugins.deploy.run import Exported as ExportedModel

WINDOWS = 256
"""The ONNX file is checked on so many."""

app = typer.Typer()


@app.command("export-model", hidden=True)
def export_model(
    model: Annotated[Path, typer.Argument()],
    out: Annotated[Path, typer.Option("--out")],
    store: Annotated[Path | None, typer.Option("--store")] = None,
    campaign: CampaignOption = None,
    onnx: Annotated[bool, typer.Option("--onnx/--no-onnx")] = True,
    windows: Annotated[int, typer.Option("--windows", min=1, max=1_000_000)] = WINDOWS,
    as_json: JsonOption = False,
) -> None:
    """Former name of `export`."""
    given = {"store": store, "campaign": campaign}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if onnx:
        options["windows"] = windows
    form = "onnx" if onnx else "card"
    former("export-model", ExportRequest(str(model), "", form, out, options), as_json)


def write(request: ExportRequest) -> ExportResult:
    """Write a network's resource use on a Speck chip and its model card, and ONNX unless `card`."""
    from sliplab.flows.detecting.request import load_model
    from sliplab.storage.remote.mirror import open_store

    model, out = Path(request.place), request.output
    store = request.options.get("store")
    if out.exists() and not out.is_dir():
        raise InputError("--output", "", str(out), "must be a folder")
    fitted = load_model(model)
    folder = store or model.resolve().parent.parent
    if store is None and not (folder / "store.json").exists():
        raise InputError("--store", "", None, f"is required: {model} is not in a store")
    opened = open_store(folder)
    prepare_store(folder)
    from sliplab.plugins.deploy.run import export_model as run

    result = run(
        model,
        fitted,
        out,
        opened,
        request.options.get("campaign"),
        onnx=request.form == "onnx",
        checked=request.options.get("windows", WINDOWS),
    )
    for warning in (*result["warnings"], *result["problems"]):
        console.say(f"warning: {warning}")
    simulated = " (simulated data)" if result["simulated"] else ""
    return ExportResult(f"exported to {out}{simulated}", result, _model_pairs(result))


def refuse_nir(request: ExportRequest) -> ExportResult:
    """NIR (Pedersen et al., 2024) has no neuron like these. Raises InputError: always."""
    from sliplab.flows.detecting.request import load_model

    load_model(Path(request.place))
    raise InputError(
        "--as",
        "",
        "nir",
        "cannot hold this network: NIR's integrate-and-fire neuron subtracts its threshold after "
        "a spike, and the network's is reset to zero, so nearly every window would count "
        "otherwise (docs/models.md). --as onnx holds the neurons as they are",
    )


CARD = Export("model", write, frozenset({"store", "campaign"}))
ONNX = Export("model", write, CARD.options | {"windows"})
NIR = Export("model", refuse_nir, possible=False)


def _model_pairs(result: ExportedModel) -> dict[str, object]:
    change, accuracy = result["change"], result["accuracy"]
    checked = result["onnx_windows_equal"]
    return {
        "files": ", ".join(Path(file).name for file in result["files"]),
        "onnx": f"{checked} of {plural(checked, 'window')} as in Sinabs"
        if checked
        else "not written",
        "speck": "fits, one core a layer" if result["speck_fits"] else "does not fit",
        "8 bits: equal counts": f"{change.equal_counts:.1%} of {plural(change.windows, 'window')}",
        "8 bits: equal class": f"{change.equal_class:.1%}",
        "strict accuracy": f"{accuracy['real'].strict:.1%}, with 8 bits "
        f"{accuracy['whole'].strict:.1%}",
        "synaptic operations a window": f"{result['synaptic_operations']:,.0f}",
    }
