"""`sliplab export-model`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import DATA, CampaignOption, JsonOption
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.plugins.deploy.run import Exported

app = typer.Typer()


@app.command(
    "export-model",
    rich_help_panel=DATA,
    epilog="Example: sliplab export-model my-store/models/seed0.pt --out exported",
)
def export_model(
    model: Annotated[Path, typer.Argument(help="A trained network: STORE/models/seed0.pt.")],
    out: Annotated[Path, typer.Option("--out", help="Output folder; created if missing.")],
    store: Annotated[
        Path | None,
        typer.Option(
            "--store", help="Store that provides the test windows; default: the model's own."
        ),
    ] = None,
    campaign: CampaignOption = None,
    onnx: Annotated[
        bool, typer.Option("--onnx/--no-onnx", help="Write ONNX, checked against Sinabs.")
    ] = True,
    windows: Annotated[
        int,
        typer.Option(
            "--windows", min=1, max=1_000_000, help="Number of windows to check the ONNX file on."
        ),
    ] = 256,
    as_json: JsonOption = False,
) -> None:
    """Export a network as ONNX, with its resource use on a Speck chip and a model card."""
    from sliplab.flows.detecting.request import load_model
    from sliplab.storage.remote.mirror import open_store

    if out.exists() and not out.is_dir():
        raise InputError("--out", "", str(out), "must be a folder")
    fitted = load_model(model)
    folder = store or model.resolve().parent.parent
    if store is None and not (folder / "store.json").exists():
        raise InputError("--store", "", None, f"is required: {model} is not in a store")
    opened = open_store(folder)
    prepare_store(folder)
    from sliplab.plugins.deploy.run import export_model as run

    result = run(model, fitted, out, opened, campaign, onnx=onnx, checked=windows)
    for warning in (*result["warnings"], *result["problems"]):
        console.say(f"warning: {warning}")
    if as_json:
        console.print_json(result)
    else:
        simulated = " (simulated data)" if result["simulated"] else ""
        console.print_pairs(f"exported to {out}{simulated}", _model_pairs(result))


def _model_pairs(result: Exported) -> dict[str, str]:
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
