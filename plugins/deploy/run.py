"""A trained network as ONNX and for a Speck, with a model card (`sliplab export --as onnx`).

Nothing is written until everything is complete and the ONNX file reproduces Sinabs' spike counts.
"""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.campaigns import collected
from sliplab.analysis.networks.training import Fitted
from sliplab.flows.running import console
from sliplab.plugins.deploy.export import CHECKED, ExportFigures, export_files
from sliplab.storage.files import make_folder, write_bytes, write_text
from sliplab.storage.trials.store import TrialStore


class Exported(ExportFigures):
    """Figures of an exported network, and the paths of its files."""

    files: list[str]


def export_model(
    model: Path,
    fitted: Fitted,
    out: Path,
    store: TrialStore,
    names: list[str] | None = None,
    *,
    onnx: bool = True,
    checked: int = CHECKED,
) -> Exported:
    """Write ``NAME.onnx``, ``NAME.speck.{json,md,npz}`` and ``NAME.card.{json,md}`` into `out`.

    Args:
        model, fitted: the file, and what is in it.
        names: campaigns of the store; all by default.
        onnx: make the ONNX file, which needs the extra of that name.
        checked: windows to check it on.

    Raises:
        InputError: the store's windows differ from the model's.
        StoreError: nothing collected, or not labelled.
        ExportFailed: the ONNX file gives other counts.
        ModuleNotFoundError: the extra ``onnx`` is not installed.
    """
    campaigns = collected(store, names)
    trials = sum(1 for item in campaigns for _ in item.of_split("test"))
    with console.bar("export", 4 + trials) as bar:
        files, figures = export_files(
            model,
            fitted,
            store,
            campaigns,
            checked if onnx else None,
            lambda part: bar.advance(1, part),
        )
    make_folder(out)
    for suffix, content in files.items():
        path = out / f"{model.stem}{suffix}"
        if isinstance(content, bytes):
            write_bytes(path, content)
        else:
            write_text(path, content)
    return {"files": [str(out / f"{model.stem}{suffix}") for suffix in files], **figures}
