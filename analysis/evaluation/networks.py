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
from sliplab.analysis.networks import model_file, training
from sliplab.analysis.networks.external_model import ExternalModel, load_external, names_function
from sliplab.analysis.networks.models import comparison_models, rules_of, training_settings
from sliplab.analysis.networks.network import spike_counts
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
from sliplab.storage.trials.store import StoreError, TrialStore

STEP = "other_networks"
VERSION = 1
Engines = Literal["fast", "sinabs"]
CountedBy = Engines | Literal["function", "predictions"]
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True)
class OtherNetwork:
    """A network that is evaluated in addition to the store's own.

    Attributes:
        name: of the stored results, safe as a file name.
        title: for people.
        content: its file's bytes.
        external: of another program; None for a model file of this one.
        windows: what it takes.
        outputs_per_class: in the mean.
        engine: counts its spikes: the event-driven kernels, Sinabs, which gives the same counts, or
            a function of another program; ``predictions`` where that did it before.
    """

    name: str
    title: str
    content: bytes
    external: ExternalModel | None
    windows: Windows
    outputs_per_class: float
    engine: CountedBy

    @cached_property
    def key(self) -> str:
        """Hash of the file and the engine, on which its counts depend."""
        mark = None if self.external is None else self.external.fingerprint
        return hash_data([self.content.hex(), mark, self.engine])


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
    """Return a network to evaluate from a model file, or from a function of another program.

    Args:
        path: the model file, or ``FILE.py:FUNCTION`` (`networks.external_model`).
        engine: of a model file: the kernels by default; Sinabs gives the same counts.

    Raises:
        InputError: file, key, value and what would be right.
    """
    if names_function(path):
        if engine is not None:
            raise InputError("--engine", "", engine, f"is of model files; {path} is a function")
        return _external(load_external(path))
    try:
        content = read_plain(path)
    except OSError as error:
        raise InputError(path, "", None, f"cannot be read: {error.strerror}") from None
    try:
        fitted = model_file.parse(content, str(path))
    except ValueError as error:
        reason = str(error).removeprefix(f"{path}: ")
        right = "give a network of another program as FILE.py:FUNCTION (docs/models.md)"
        raise InputError(path, "", None, f"{reason}; {right}") from None
    fitted.check_slip(path, "an evaluation of slip")
    return OtherNetwork(
        f"model-{path.stem}",
        path.name,
        content,
        None,
        fitted.windows,
        fitted.network.outputs_per_class,
        engine or "fast",
    )


def _external(model: ExternalModel) -> OtherNetwork:
    return OtherNetwork(
        f"model-{model.file.stem}-{model.function}",
        f"{model.file.name}:{model.function}",
        model.source,
        model,
        model.windows,
        model.outputs_per_class,
        "function",
    )


@dataclass(frozen=True)
class Judgement:
    """A network, and the trials and rules of its evaluation, found before anything is computed.

    Attributes:
        about: preset and seed of its training; None where a file brought it.
    """

    store: TrialStore
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
    store: TrialStore, campaigns: list[Collected], reviewed: bool = False
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
    counts = _counter(network.content, network.external, network.engine)
    try:
        windows, end_ns = dataset.trial_windows(recording, network.windows, judging.stride_ms)
    except ValueError as error:
        message = f"do not fit trial {recording.trial_id}: {error}"
        raise InputError(network.title, "windows", None, message) from None
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
    content: bytes, external: ExternalModel | None, engine: CountedBy
) -> Callable[[SparseWindows], I64]:
    """A function from windows to output spikes int64 (n, 3), each window from rest."""
    if external is not None:
        return lambda x: external.counts(x.dense())
    fitted = model_file.parse(content, "the model")
    if engine == "fast":
        return fitted.engine.counts
    net = training.restore(fitted)
    return lambda x: spike_counts(net, x.dense())


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
        exact=True,
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
