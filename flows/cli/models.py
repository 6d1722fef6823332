"""`sliplab export-model`: a trained network for others: ONNX, a Speck chip, a model card."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sliplab.flows.cli.common import CampaignOption, JsonOption
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.protocols.errors import InputError


def export_model(
    model: Annotated[Path, typer.Argument(help="A trained network: STORE/models/seed0.pt.")],
    out: Annotated[Path, typer.Option("--out", help="A folder; made if missing.")],
    store: Annotated[
        Path | None,
        typer.Option("--store", help="Whose windows it is checked on; the model's own by default."),
    ] = None,
    campaign: CampaignOption = None,
    onnx: Annotated[
        bool, typer.Option("--onnx/--no-onnx", help="Write ONNX, checked against Sinabs.")
    ] = True,
    windows: Annotated[
        int,
        typer.Option(
            "--windows", min=1, max=1_000_000, help="Windows that the ONNX file is checked on."
        ),
    ] = 256,
    as_json: JsonOption = False,
) -> None:
    """Write a network as ONNX, what it takes on a Speck chip, and its model card."""
    from sliplab.flows.detecting.detect_order import load_model
    from sliplab.storage.trials.store import Store

    if out.exists() and not out.is_dir():
        raise InputError("--out", "", str(out), "must be a folder")
    fitted = load_model(model)
    folder = store or model.resolve().parent.parent
    if store is None and not (folder / "store.json").exists():
        raise InputError("--store", "", None, f"is needed: {model} lies in no store")
    opened = Store.open(folder)
    prepare_store(folder)
    from sliplab.flows.learning.model_export import export_model as run

    result = run(model, fitted, out, opened, campaign, onnx=onnx, checked=windows)
    for warning in (*result["warnings"], *result["problems"]):
        console.say(f"warning: {warning}")
    if as_json:
        console.print_json(result)
    else:
        simulated = " (simulated data)" if result["simulated"] else ""
        console.print_pairs(f"exported to {out}{simulated}", _shown(result))


def _shown(result: dict[str, Any]) -> dict[str, Any]:
    change, accuracy = result["change"], result["accuracy"]
    checked = result["onnx_windows_equal"]
    return {
        "files": ", ".join(Path(file).name for file in result["files"]),
        "onnx": f"{checked} of {checked} windows as in Sinabs" if checked else "not written",
        "speck": "fits, one core a layer" if result["speck_fits"] else "does not fit",
        "8 bits: equal counts": f"{change['equal_counts']:.1%} of {change['windows']} windows",
        "8 bits: equal class": f"{change['equal_class']:.1%}",
        "strict accuracy": f"{accuracy['real']['strict']:.1%}, with 8 bits "
        f"{accuracy['whole']['strict']:.1%}",
        "synaptic operations a window": f"{result['synaptic_operations']:,.0f}",
    }


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command("export-model")(export_model)
