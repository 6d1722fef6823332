"""Training: the network of every seed, from the labelled trials of the kinematic campaigns."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from analysis import dataset, model_file, training
from analysis.dataset import SampleSet
from flows import console
from flows.campaigns import Collected, training_campaigns
from flows.orchestration import Parcel, run
from flows.reviewed import Labels
from flows.timing import timed
from flows.trial_work import TrialWork, each_trial
from protocols.hashing import hash_integer
from protocols.settings import AnalysisSettings, Samples, Windows
from storage.derived import make_key
from storage.files import read_json, write_json
from storage.recording import Recording
from storage.store import Store, StoreError

if TYPE_CHECKING:
    from flows.cluster import Cluster

VERSION = 1


@dataclass(frozen=True)
class Model:
    """A trained network on disk."""

    seed: int
    path: Path
    key: str

    @property
    def info_path(self) -> Path:
        """The JSON beside the model file; written last, it decides."""
        return self.path.with_suffix(".json")

    @property
    def fresh(self) -> bool:
        """Whether the file was made with `key`."""
        try:
            return self.path.exists() and read_json(self.info_path)["key"] == self.key
        except (OSError, ValueError, KeyError):
            return False


def training_settings(campaigns: list[Collected]) -> AnalysisSettings:
    """The settings that the network is made by: those of the first kinematic campaign."""
    return training_campaigns(campaigns)[0].settings


def wanted_models(store: Store, campaigns: list[Collected], reviewed: bool = False) -> list[Model]:
    """The models that the settings ask for, with the keys they must have.

    Args:
        reviewed: people's decisions are applied to the labels.

    Raises:
        StoreError: a trial has no fresh label yet.
    """
    used = training_campaigns(campaigns)
    settings = used[0].settings
    inputs = []
    labels = Labels(store, reviewed)
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
    parameters["training"] = settings.training.model_dump(mode="json", exclude={"seeds"})
    models = []
    for seed in settings.training.seeds:
        key = make_key(
            "train", VERSION, inputs, {**parameters, "seed": seed, "dataset": dataset.VERSION}
        )
        models.append(Model(seed, store.folder / "models" / f"seed{seed}.pt", key))
    return models


def load_samples(
    labels: Labels, campaigns: list[Collected], split: str, cluster: Cluster | None = None
) -> SampleSet:
    """The samples of all trials of one split of the kinematic campaigns.

    Without a cluster in this process: a trial takes 10 ms. With one it stands in a flow.
    """
    used = training_campaigns(campaigns)
    windows = used[0].settings.windows
    work = [
        TrialWork(
            recording, item.name, "",
            _Wanted(
                labels.read(item, recording), trial.index, windows,
                item.settings.samples, hash_integer("samples", trial.id),
            ),
        )
        for item in used
        for trial, recording in item.of_split(split)
    ]  # fmt: skip
    parts: dict[int, SampleSet] = {}
    each_trial(
        labels.store,
        f"samples to {split}",
        work,
        _samples,
        parts.__setitem__,
        cluster,
        processes=False,
    )
    return SampleSet.join([parts[number] for number in range(len(work))], windows)


@dataclass(frozen=True)
class _Wanted:
    """What a trial's samples depend on besides the trial: see `dataset.trial_samples`."""

    label: dict[str, Any]
    number: int
    windows: Windows
    samples: Samples
    seed: int


def _samples(recording: Recording, wanted: _Wanted) -> SampleSet:
    return dataset.trial_samples(
        recording, wanted.label, wanted.number, wanted.windows, wanted.samples, wanted.seed
    )


@task(name="train one seed", cache_policy=NO_CACHE, persist_result=False)
def train_one(job: Parcel[tuple[Model, SampleSet, SampleSet, AnalysisSettings]]) -> int:
    """Train one network and keep it."""
    model, train, validation, settings = job.content
    total = settings.training.epochs
    with console.bar(f"train seed {model.seed} (epochs)", total) as bar:
        fitted = training.fit(
            train.x,
            train.y,
            validation.x,
            validation.y,
            settings.network,
            settings.windows,
            settings.training,
            model.seed,
            on_epoch=lambda record: bar.advance(
                1, f"loss {record.loss:.3f}, validation {record.val_strict:.3f} strict"
            ),
        )
    for warning in fitted.warnings:
        console.say(f"warning: {warning}")
    model.path.parent.mkdir(parents=True, exist_ok=True)
    model_file.save(model.path, fitted)
    info = {
        "key": model.key,
        "seed": model.seed,
        "samples": {"train": len(train), "validation": len(validation)},
        "chosen_epoch": fitted.chosen_epoch,
        "validation": {
            "argmax": fitted.chosen.val_argmax,
            "strict": fitted.chosen.val_strict,
            "margin": fitted.chosen.val_margin,
        },
        "warnings": list(fitted.warnings),
    }
    write_json(model.info_path, info)
    return model.seed


@flow(name="train", validate_parameters=False, persist_result=False)
def train_flow(
    wanted: Parcel[tuple[Labels, list[Collected], list[Model], Cluster | None]],
) -> int:
    """Train the seeds that are stale, one after the other."""
    labels, campaigns, models, cluster = wanted.content
    settings = training_settings(campaigns)
    with timed(labels.store, "train"):
        train = load_samples(labels, campaigns, "train", cluster)
        validation = load_samples(labels, campaigns, "validation", cluster)
        for name, part in (("training", train), ("validation", validation)):
            if not len(part):
                raise StoreError(f"there are no {name} samples; collect more trials")
        for model in models:
            train_one(Parcel((model, train, validation, settings)))
    return len(models)


def train(
    store: Store,
    campaigns: list[Collected],
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> dict[str, Any]:
    """Train what is missing or stale.

    Args:
        cluster: what makes the samples; this machine trains.
        reviewed: people's decisions are applied to the labels.
    """
    labels = Labels(store, reviewed)
    models = wanted_models(store, campaigns, reviewed)
    stale = [model for model in models if not model.fresh]
    if stale:
        run(train_flow, Parcel((labels, campaigns, stale, cluster)), cluster)
    return {
        "step": "train",
        "done": len(stale),
        "fresh": len(models) - len(stale),
        **labels.told(campaigns),
    }
