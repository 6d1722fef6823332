"""Other networks on the store's test trials: the preset that `also` names, and models of files.

They are evaluated by the functions that score the store's own network, on the same windows and
trials, and by the rule in spikes of their own outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from sliplab.analysis.campaigns import Collected, training_campaigns
from sliplab.analysis.evaluation import windows as window_scores
from sliplab.analysis.evaluation.trials import score_row, summaries
from sliplab.analysis.evaluation.windows import intervals_of
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics import classification as metrics
from sliplab.analysis.metrics import window_groups
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.external_model import Description, ExternalModel, load_external
from sliplab.analysis.networks.models import comparison_models, rules_of, training_settings
from sliplab.analysis.networks.network import spike_counts
from sliplab.analysis.networks.spiking import SpikeEngine
from sliplab.analysis.trial_work import KeepTrials, TrialWork, stale_trials
from sliplab.analysis.windows import dataset
from sliplab.analysis.windows.sparse import SparseWindows
from sliplab.protocols.detection import Detection
from sliplab.protocols.errors import InputError
from sliplab.protocols.hashing import hash_data, hash_integer
from sliplab.protocols.windows import SampleSettings, Windows
from sliplab.storage.files import read_plain
from sliplab.storage.schema.evaluation import OtherEvaluation, OtherWindowScores, TrialScore
from sliplab.storage.schema.label import TrialLabel
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Arrays, Derived, make_key
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import Store, StoreError

STEP = "other_networks"
VERSION = 1
Engines = Literal["fast", "sinabs"]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class OtherNetwork:
    """A network that is evaluated in addition to the store's own.

    Attributes:
        name: of the stored results, safe as a file name.
        title: for people.
        content: its file's bytes: a model file of this program, or weights of `description`.
        windows: what it takes.
        outputs_per_class: in the mean.
        engine: counts its spikes: the event-driven kernels, or Sinabs; ``predictions`` where
            another program did.
        exact: whether both give the same counts by arithmetic.
    """

    name: str
    title: str
    content: bytes
    description: Description | None
    windows: Windows
    outputs_per_class: float
    engine: Engines | Literal["predictions"]
    exact: bool

    @cached_property
    def key(self) -> str:
        """Hash of the file and the engine, on which its counts depend."""
        stated = None if self.description is None else self.description.model_dump(mode="json")
        return hash_data([self.content.hex(), stated, self.engine])


@dataclass(frozen=True)
class _Judging:
    """Inputs of a trial's counts besides the trial."""

    network: OtherNetwork
    label: TrialLabel | None
    """Label of a trial that samples are taken from as well; None for others."""
    samples: SampleSettings
    seed: int
    stride_ms: int
    threads: int | None


def network_of(path: Path, engine: Engines | None = None) -> OtherNetwork:
    """Return a network to evaluate from a model file, or from a state_dict with its description.

    Args:
        path: the model file, the description (YAML or JSON), or the weights with a description of
            the same name in the same folder.
        engine: by default the kernels where they give Sinabs' counts by arithmetic, else Sinabs.

    Raises:
        InputError: file, key, value and what would be right.
    """
    if path.suffix.lower() in {".yaml", ".yml", ".json"}:
        return _described(path, engine)
    try:
        content = read_plain(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    try:
        fitted = model_file.parse(content, str(path))
    except ValueError as error:
        for suffix in (".yaml", ".yml", ".json"):
            if path.with_suffix(suffix).exists():
                return _described(path.with_suffix(suffix), engine)
        reason = str(error).removeprefix(f"{path}: ")
        raise InputError(
            path,
            "",
            None,
            f"{reason}; a state_dict needs a description next to it, such as "
            f"{path.with_suffix('.yaml').name} (docs/models.md)",
        ) from None
    fitted.check_slip(path, "an evaluation of slip")
    return OtherNetwork(
        f"model-{path.stem}",
        path.name,
        content,
        None,
        fitted.windows,
        fitted.network.outputs_per_class,
        engine or "fast",
        exact=True,
    )


def _described(path: Path, engine: Engines | None) -> OtherNetwork:
    model = load_external(path)
    if model.description.classes != CLASSES:
        raise InputError(
            path,
            "classes",
            list(model.description.classes),
            f"must be {', '.join(CLASSES)} for an evaluation of slip",
        )
    exact = model.on_grid()
    if engine == "fast":
        try:
            model.fast()
        except ValueError as error:
            reason = f"cannot run {path}: {error}; use sinabs"
            raise InputError("--engine", "", engine, reason) from None
    return OtherNetwork(
        f"model-{path.stem}",
        Path(model.description.weights).name,
        model.weights,
        model.description,
        model.windows,
        model.outputs_per_class,
        engine or ("fast" if exact else "sinabs"),
        exact,
    )


@dataclass(frozen=True)
class Judgement:
    """A network, and the trials and rules of its evaluation, found before anything is computed.

    Attributes:
        about: preset and seed of its training; None where a file brought it.
    """

    store: Store
    campaigns: list[Collected]
    labels: StoreLabels
    network: OtherNetwork
    rules: dict[str, Detection]
    about: dict[str, Any]

    @property
    def data_key(self) -> str:
        """Key of the trials and labels alone."""
        return data_key(self.labels, self.campaigns)

    @property
    def key(self) -> str:
        """Key of all inputs of the result."""
        network = self.network
        rules = {name: rule.model_dump(mode="json") for name, rule in self.rules.items()}
        return make_key(
            STEP,
            VERSION,
            [network.key, self.data_key, network.title, self.about, window_scores.VERSION],
            rules,
        )

    @property
    def applied(self) -> dict[str, Detection]:
        """The rules in the unit of the stored counts."""
        return self.rules

    @property
    def fresh(self) -> bool:
        """True where nothing changed since it was evaluated."""
        return Derived.of(self.store, STEP).fresh(self.network.name, self.key)

    def count(self, keep: KeepTrials, threads: int | None = None) -> None:
        """Count spikes of every test trial.

        Args:
            keep: makes the stale ones and keeps each; threads: of the network, None for all.
        """
        network = self.network
        kinematic = {item.name for item in training_campaigns(self.campaigns)}
        samples = training_settings(self.campaigns).samples
        work = []
        for item in self.campaigns:
            stride = self.rules[item.name].stride_ms or network.windows.length_ms
            for trial, recording in item.of_split("test"):
                label = self.labels.read(item, recording) if item.name in kinematic else None
                key = make_key(
                    STEP,
                    VERSION,
                    [network.key, recording.checksum, self.labels.key(item, recording)],
                    [network.windows.model_dump(mode="json"), samples.model_dump(), stride],
                )
                seed = hash_integer("samples", trial.id)
                judging = _Judging(network, label, samples, seed, stride, threads)
                work.append(TrialWork(recording, item.name, key, judging))
        step = counts_step(network)
        if stale := stale_trials(self.store, step, work):
            keep(step, stale, _count)


def file_judgement(
    labels: StoreLabels,
    campaigns: list[Collected],
    network: OtherNetwork,
    margin: float | None = None,
    smoothing: int | None = None,
) -> Judgement:
    """Return a network of a file with the protocols' rules, in spikes of the network's outputs.

    Args:
        margin, smoothing: instead of the protocols' own.
    """
    change = {"margin": margin, "smoothing": smoothing, "choose": "protocol"}
    change = {name: value for name, value in change.items() if value is not None}
    rules = {
        name: Detection.model_validate({**rule.model_dump(), **change, "compare": None})
        for name, rule in rules_of(campaigns, network.outputs_per_class).items()
    }
    about = {"preset": None, "seed": None}
    return Judgement(labels.store, campaigns, labels, network, rules, about)


def comparison_judgements(labels: StoreLabels, campaigns: list[Collected]) -> list[Judgement]:
    """Return the networks that `analysis.also` names, each with its preset's rule.

    Raises:
        StoreError: a network is missing or stale.
    """
    found = []
    for model in comparison_models(labels.store, campaigns, labels.reviewed):
        if not model.fresh:
            raise StoreError(f"{model.path}: is missing or stale; run `sliplab train` first")
        settings = model.settings
        network = OtherNetwork(
            f"preset-{settings.preset}",
            f"preset: {settings.preset}",
            model.path.read_bytes(),
            None,
            settings.windows,
            settings.network.outputs_per_class,
            "fast",
            exact=True,
        )
        rules = {
            item.name: settings.detection.model_copy(
                update={"false_early_ms": item.settings.detection.false_early_ms}
            )
            for item in campaigns
        }
        about = {"preset": settings.preset, "seed": model.seed}
        found.append(Judgement(labels.store, campaigns, labels, network, rules, about))
    return found


def data_key(labels: StoreLabels, campaigns: list[Collected]) -> str:
    """The key of the test trials and their labels.

    Raises:
        StoreError: a trial has no label.
    """
    inputs = []
    for item in campaigns:
        for trial, recording in item.of_split("test"):
            if not labels.fresh(item, recording):
                raise StoreError(f"{item.name}: {trial.id} has no label yet; run `sliplab label`")
            inputs.append([item.name, trial.id, recording.checksum, labels.key(item, recording)])
    return make_key(STEP, VERSION, inputs, training_settings(campaigns).samples.model_dump())


def retained(
    store: Store, campaigns: list[Collected], reviewed: bool = False
) -> dict[str, OtherEvaluation]:
    """Results on the trials and labels of today, by name."""
    folder = Derived.of(store, STEP)
    key = data_key(StoreLabels(store, reviewed), campaigns)
    found = {}
    for path in sorted(folder.folder.glob("*.json")):
        if folder.read(path.stem).get("data_key") == key:
            found[path.stem] = folder.load(path.stem, OtherEvaluation)
    return found


def counts_step(network: OtherNetwork) -> str:
    """Return the step that stores its counts of the test trials."""
    return f"counts-{network.name}"


def _count(recording: Recording, judging: _Judging) -> tuple[Json, Arrays]:
    """Spikes of the windows of a trial, one after the other, and of those that are samples."""
    network = judging.network
    if judging.threads is not None:
        training.limit_threads(judging.threads)
    counts = _counter(network.content, network.description, network.engine)
    windows, end_ns = dataset.trial_windows(recording, network.windows, judging.stride_ms)
    found = {"counts": counts(windows), "end_ns": end_ns}
    if judging.label is not None:
        trial = dataset.TrialId(recording.folder.parents[1].name, recording.folder.name)
        samples = dataset.trial_samples(
            recording, judging.label, trial, network.windows, judging.samples, judging.seed
        )
        found |= {"sample_counts": counts(samples.windows), "y": samples.y}
    return {}, found


@lru_cache(maxsize=2)
def _counter(
    content: bytes, description: Description | None, engine: str
) -> Callable[[SparseWindows], I64]:
    """A function from windows to output spikes int64 (n, 3), each window from rest."""
    if description is None:
        fitted = model_file.parse(content, "the model")
        if engine == "fast":
            return fitted.engine.counts
        net = training.restore(fitted)
        return lambda x: spike_counts(net, x.dense())
    model = ExternalModel(description, content)
    if engine == "fast":
        return SpikeEngine(model.fast(), model.windows.cells).counts
    sinabs = model.sinabs()
    return lambda x: sinabs.counts(x.dense())


def score_network(job: Judgement) -> None:
    """Windows, detections and latencies, stored as one result."""
    network = job.network
    rows: list[TrialScore] = []
    counts: list[I64] = []
    labels: list[I64] = []
    places: list[I64] = []
    rules = job.applied
    for item in job.campaigns:
        made = Derived.of(job.store, counts_step(network), item.name)
        for trial, recording in item.of_split("test"):
            arrays = made.arrays(recording.folder.name)
            label = job.labels.read(item, recording)
            rule = rules[item.name]
            rows.append(score_row(item, trial, label, arrays["counts"], arrays["end_ns"], rule))
            if "y" in arrays:
                counts.append(arrays["sample_counts"])
                labels.append(arrays["y"])
                places.append(np.full(len(arrays["y"]), len(places), np.int64))
    margin = rules[training_campaigns(job.campaigns)[0].name].margin
    result = OtherEvaluation(
        data_key=job.data_key,
        title=network.title,
        engine=network.engine,
        exact=network.exact,
        **job.about,
        windows=_windows(counts, labels, places, margin),
        trials=tuple(rows),
        experiments=summaries(rows),
        detection=job.rules,
    )
    Derived.of(job.store, STEP).write(network.name, job.key, result)


def _windows(
    counts: Sequence[I64], labels: Sequence[I64], places: Sequence[I64], margin: float
) -> OtherWindowScores:
    """Figures of the sample windows, with intervals over trials."""
    none = np.empty(0, np.int64)
    all_counts = np.concatenate([np.empty((0, 3), np.int64), *counts])
    y, trial = np.concatenate([none, *labels]), np.concatenate([none, *places])
    return OtherWindowScores(
        **dict(metrics.score(all_counts, y, margin)),
        interval=window_groups.share(window_groups.strict_hits(all_counts, y), trial),
        window_intervals=intervals_of(all_counts, y, trial),
    )
