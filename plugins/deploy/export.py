"""A trained network as ONNX, on a Speck, and with a card.

Every stated property of the network is measured on windows of a store, by default the model's own.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.networks import training
from sliplab.analysis.networks.models import (
    comparison_models,
    rules_of,
    training_settings,
    wanted_models,
)
from sliplab.analysis.networks.network import SPIKING, WEIGHTED
from sliplab.analysis.networks.quantised import Quantised, quantise
from sliplab.analysis.networks.synaptic import count_work
from sliplab.analysis.networks.training import Fitted
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.plugins.deploy.card import SplitResult, card_markdown, model_card
from sliplab.plugins.deploy.chip import chip_run, compare, latencies, quantised_net, rounding
from sliplab.plugins.deploy.document import (
    CardCampaign,
    CardData,
    ModelCard,
    ModelFile,
    Quantisation,
    QuantisedLayer,
    SpeckDescription,
)
from sliplab.plugins.deploy.speck import speck_fit, speck_markdown
from sliplab.protocols.errors import InputError
from sliplab.storage.files import json_text, sha256
from sliplab.storage.schema.evaluation import Accuracy, CountChange, Latencies
from sliplab.storage.schema.model import TrainedModel
from sliplab.storage.trials.store import StoreError, TrialStore

SPLITS = ("train", "validation", "test")
CHECKED = 256
"""Windows of the test trials on which the ONNX file is compared with Sinabs."""
PACKAGES = ("sliplab", "torch", "sinabs", "numpy", "numba")
SPECK_FORMAT = "sliplab-speck-1"


class ExportFailed(StoreError):
    """An exported file gives other results than the network, or could not be made."""


@dataclass(frozen=True)
class _Source:
    """A model, and the store on which it is measured."""

    path: Path
    sha256: str
    fitted: Fitted
    store: TrialStore
    campaigns: list[Collected]
    labels: StoreLabels

    @property
    def simulated(self) -> bool:
        """True where any campaign's data is simulated."""
        return any(bool(item.info["simulated"]) for item in self.campaigns)

    @property
    def margin(self) -> float:
        """The lead by which windows are evaluated, in spikes of this network."""
        rules = rules_of(self.campaigns, self.fitted.network.outputs_per_class)
        return rules[training_campaigns(self.campaigns)[0].name].margin

    @property
    def about(self) -> ModelFile:
        """Description of the model in every exported file."""
        return ModelFile(file=self.path.name, sha256=self.sha256)


def _weights_file(whole: Quantised) -> bytes:
    """The whole weights and biases as NumPy's archive, int8; the same bytes for the same ones."""
    buffer = io.BytesIO()
    arrays: dict[str, Any] = dict(whole.weights)
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _made_from_these(source: _Source) -> bool:
    """Return True where `train` would make this model of the store now. Raises StoreError."""
    current = {
        model.key
        for make in (wanted_models, comparison_models)
        for model in make(source.store, source.campaigns)
    }
    try:
        return TrainedModel.load(source.path.with_suffix(".json")).key in current
    except (OSError, ValueError):
        return False


def _first_set(samples: dict[str, SampleSet]) -> SampleSet:
    """Return the samples that figures are measured on: those of test trials, else any others."""
    for split in reversed(SPLITS):
        if len(samples[split]):
            return samples[split]
    raise StoreError("there are no samples to look at; collect and label more trials")


def _onnx(source: _Source, x: npt.NDArray[np.uint8], checked: int) -> tuple[bytes, int]:
    """Return the ONNX file, and the number of windows on which it was verified."""
    from sliplab.plugins.deploy.onnx_file import OnnxDiffers, check_onnx, to_onnx

    windows = source.fitted.windows
    about = {
        "file": source.about.file,
        "sha256": source.about.sha256,
        "classes": ",".join(metrics.CLASSES),
        "windows": windows.model_dump_json(),
        "simulated": str(source.simulated).lower(),
    }
    some = x[np.unique(np.linspace(0, len(x) - 1, min(checked, len(x))).astype(int))]
    net = training.restore(source.fitted)
    try:
        data = to_onnx(net, windows, about)
        return data, check_onnx(data, net, some)
    except OnnxDiffers as error:
        raise ExportFailed(f"{source.path}: nothing was written: {error}") from None


def _speck(
    source: _Source,
    whole: Quantised,
    seen: SampleSet,
    real: Latencies,
    chip: Latencies,
) -> SpeckDescription:
    """The description of the network on the chip."""
    fitted = source.fitted
    net = training.restore(fitted)
    margin = source.margin
    ran = chip_run(quantised_net(fitted, whole), seen.x)
    counts = fitted.engine.counts(seen.windows)
    errors = rounding(whole, net)
    layers = {
        name: QuantisedLayer(
            scale=whole.scales[name],
            threshold=whole.thresholds[spiking],
            rounding=errors[name],
            potential=ran.potentials[spiking],
            saturated=ran.saturated[spiking],
        )
        for name, spiking in zip(WEIGHTED, SPIKING, strict=True)
    }
    accuracy = {
        name: metrics.accuracy(each, seen.y, margin)
        for name, each in (("real", counts), ("whole", ran.counts))
    }
    return SpeckDescription(
        format=SPECK_FORMAT,
        simulated=source.simulated,
        model=source.about,
        fit=speck_fit(fitted.network, fitted.windows).document(),
        quantisation=Quantisation(
            layers=layers, change=compare(counts, ran.counts, margin), accuracy=accuracy
        ),
        detection={"real": real, "whole": chip},
    )


def _card(
    source: _Source,
    samples: dict[str, SampleSet],
    seen: SampleSet,
    detection: Latencies,
    made_from_these: bool,
) -> ModelCard:
    engine, work = source.fitted.engine, count_work(source.fitted, seen.windows)
    assert work is not None  # `seen` has windows
    kinematic = training_campaigns(source.campaigns)
    splits = {
        split: SplitResult(
            engine.counts(part.windows),
            part.y,
            sum(1 for item in kinematic for _ in item.of_split(split)),
        )
        for split, part in samples.items()
        if len(part)
    }
    campaigns = (
        CardCampaign(
            name=item.name,
            experiment=item.experiment,
            protocol=item.planned.name,
            collection_hash=item.planned.collection_hash,
            analysis_hash=item.planned.analysis_hash,
            rig=item.info.get("rig", "imported"),
            simulated=item.info["simulated"],
            trials={split: sum(1 for _ in item.of_split(split)) for split in SPLITS},
        )
        for item in source.campaigns
    )
    data = CardData(
        store=source.store.folder.resolve().name,
        simulated=source.simulated,
        made_from_these_data=made_from_these,
        campaigns=tuple(campaigns),
    )
    versions = {name: version(name) for name in PACKAGES}
    margin = source.margin
    return model_card(
        source.fitted,
        source.about,
        data,
        splits,
        work,
        detection,
        versions,
        margin,
    )


class ExportFigures(TypedDict):
    """Figures of an exported network.

    Attributes:
        onnx_windows_equal: windows on which the ONNX file gave Sinabs' counts.
        change, accuracy: see `storage.schema.export.Quantisation`.
        synaptic_operations: of all layers, a window.
    """

    simulated: bool
    onnx_windows_equal: int
    speck_fits: bool
    problems: list[str]
    change: CountChange
    accuracy: dict[str, Accuracy]
    synaptic_operations: float
    warnings: list[str]


def export_files(
    model: Path,
    fitted: Fitted,
    store: TrialStore,
    campaigns: list[Collected],
    checked: int | None,
    advance: Callable[[str], None],
) -> tuple[dict[str, bytes | str], ExportFigures]:
    """Make the files of a model, and report its main figures.

    Args:
        checked: windows that the ONNX file is compared with Sinabs on; None for no such file.
        advance: hears of each part that is done; 4 parts and each test trial.

    Returns:
        contents by the ending of the file's name, and the figures.

    Raises:
        InputError: the store's windows differ from the model's, or its classes are not those
            of slip.
        StoreError: not labelled.
        ExportFailed: the ONNX file gives other counts.
        ModuleNotFoundError: the extra ``onnx`` is not installed.
    """
    fitted.check_slip(model, "a Speck")
    if training_settings(campaigns).windows != fitted.windows:
        file = training_campaigns(campaigns)[0].campaign.protocol_file
        raise InputError(file, "analysis.windows", None, f"are not those that {model} takes")
    source = _Source(model, sha256(model), fitted, store, campaigns, StoreLabels(store))
    files: dict[str, bytes | str] = {}
    made_from_these = _made_from_these(source)
    samples = {split: load_samples(source.labels, campaigns, split) for split in SPLITS}
    seen = _first_set(samples)
    advance("windows")
    checks = 0
    if checked is not None:
        files[".onnx"], checks = _onnx(source, seen.x, checked)
    advance("onnx")
    whole = quantise(training.restore(fitted))
    real, chip = latencies(campaigns, source.labels, fitted, whole, lambda: advance("test trials"))
    speck = _speck(source, whole, seen, real, chip)
    files |= {
        ".speck.json": json_text(speck.to_json()),
        ".speck.md": speck_markdown(speck),
        ".speck.npz": _weights_file(whole),
    }
    advance("speck")
    card = _card(source, samples, seen, real, made_from_these)
    files |= {".card.json": json_text(card.to_json()), ".card.md": card_markdown(card)}
    advance("card")
    return files, {
        "simulated": source.simulated,
        "onnx_windows_equal": checks,
        "speck_fits": speck.fit.fits,
        "problems": list(speck.fit.problems),
        "change": speck.quantisation.change,
        "accuracy": speck.quantisation.accuracy,
        "synaptic_operations": card.activity.synaptic_operations["all"],
        "warnings": list(card.warnings),
    }
