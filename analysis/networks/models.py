"""Trained models of a store: their inputs, and the selection of the evaluated one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from sliplab.analysis.campaigns import Collected, agreeing, training_campaigns
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks import training
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sample_sets import CLASS_PREFIX
from sliplab.protocols.detection import Detection
from sliplab.protocols.network_settings import MARGIN
from sliplab.protocols.settings import AnalysisSettings
from sliplab.storage.schema.model import TrainedModel
from sliplab.storage.trials.derived import make_key
from sliplab.storage.trials.store import StoreError, TrialStore


@dataclass(frozen=True)
class ModelOnDisk:
    """A trained network on disk."""

    seed: int
    path: Path
    key: str
    settings: AnalysisSettings
    classes: tuple[str, ...] = ()
    """Names of the classes of recordings that show others than slip's."""

    @property
    def title(self) -> str:
        """``seed 0``, or ``paper-seed 0``."""
        return self.path.stem.replace("seed", "seed ")

    @property
    def info_path(self) -> Path:
        """The model file's JSON document; written last, it marks the model as complete."""
        return self.path.with_suffix(".json")

    @property
    def info(self) -> TrainedModel:
        """The model file's document.

        Raises:
            OSError: it does not exist.
            DocumentError, NewerFormat: it cannot be read.
        """
        return TrainedModel.load(self.info_path)

    @property
    def state_path(self) -> Path:
        """File of the training's state after its last epoch, from which it resumes."""
        return self.path.with_suffix(f".{self.key[:16]}.state")

    @property
    def curves_path(self) -> Path:
        """The training curves, redrawn after each epoch."""
        return self.path.with_suffix(".svg")

    @property
    def fresh(self) -> bool:
        """True where the file was made with `key`."""
        try:
            return self.path.exists() and self.info.key == self.key
        except (OSError, ValueError):
            return False


def training_settings(campaigns: list[Collected]) -> AnalysisSettings:
    """The settings that the network is made by: those of the first kinematic campaign."""
    return training_campaigns(campaigns)[0].settings


def rules_of(campaigns: list[Collected], outputs_per_class: float) -> dict[str, Detection]:
    """The rule of each campaign, in spikes of a network with so many output neurons a class."""
    usual = MARGIN * outputs_per_class
    margin = training_settings(campaigns).rule_for(outputs_per_class, usual).margin
    return {item.name: item.settings.rule_for(outputs_per_class, margin) for item in campaigns}


def wanted_models(
    store: TrialStore,
    campaigns: list[Collected],
    reviewed: bool = False,
    classes: tuple[str, ...] = (),
) -> list[ModelOnDisk]:
    """The models that the settings ask for, with the keys they must have.

    Args:
        reviewed: people's decisions are applied to the labels.
        classes: that the recordings show; by default slip, in the kinematic campaigns.

    Raises:
        StoreError: a trial has no fresh label yet.
        InputError: the campaigns' windows differ.
    """
    used = agreeing(campaigns) if classes else training_campaigns(campaigns)
    prefix = CLASS_PREFIX if classes else ""
    return _models(StoreLabels(store, reviewed), used, used[0].settings, prefix, classes)


def comparison_models(
    store: TrialStore, campaigns: list[Collected], reviewed: bool = False
) -> list[ModelOnDisk]:
    """Models of the comparison network that `analysis.also` names; none without one."""
    settings = training_settings(campaigns).comparison_settings()
    if settings is None:
        return []
    labels, used = StoreLabels(store, reviewed), training_campaigns(campaigns)
    return _models(labels, used, settings, f"{settings.preset}-")


def _models(
    labels: StoreLabels,
    used: list[Collected],
    settings: AnalysisSettings,
    prefix: str,
    classes: tuple[str, ...] = (),
) -> list[ModelOnDisk]:
    inputs = []
    for item in used:
        for trial, recording in item.trials:
            if not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            if trial.split in {"train", "validation"}:
                key = labels.key(item, recording)
                inputs.append([item.name, trial.id, trial.split, key])
    parameters = {
        name: getattr(settings, name).model_dump(mode="json")
        for name in ("windows", "samples", "network")
    }
    if settings.network.biases:
        del parameters["network"]["biases"]  # models of before it could be left out stay fresh
    parameters["training"] = settings.training.model_dump(mode="json", exclude={"seeds"})
    if classes:
        parameters["classes"] = classes
    models = []
    for seed in settings.training.seeds:
        key = make_key(
            "train",
            training.VERSION,
            inputs,
            {**parameters, "seed": seed, "dataset": dataset.VERSION},
        )
        path = labels.store.folder / "models" / f"{prefix}seed{seed}.pt"
        models.append(ModelOnDisk(seed, path, key, settings, classes))
    return models


def begun(model: ModelOnDisk) -> bytes | None:
    """Return the state at which a training of this model stopped; None where none began."""
    try:
        return model.state_path.read_bytes()
    except FileNotFoundError:
        return None


def choose_model(models: list[ModelOnDisk]) -> ModelOnDisk:
    """The model with the best strict validation accuracy; ties go to the first seed.

    Raises:
        StoreError: a model is missing or stale.
    """
    for model in models:
        if not model.fresh:
            raise StoreError(
                f"{model.path}: is missing or stale; run `sliplab train` first, with `--reviewed` "
                "where the evaluation has it"
            )
    return max(models, key=lambda model: model.info.validation.strict or 0.0)
