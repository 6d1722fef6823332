"""What is to be told apart in recordings, and how: one class for each kind of problem.

The steps that train, evaluate and report ask `problem_of` and know `Problem` alone. Slip by events
is here. Plug-ins add others, most simply as a `plugins.classes.problem.ClassesOfRecordings` with
classes and labels of their own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from itertools import product
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, cast

from sliplab.analysis.campaigns import (
    Collected,
    training_campaigns,
)
from sliplab.analysis.detectors.predictions import count_spikes, predict_trials, seed_step
from sliplab.analysis.evaluation import baselines, evaluation, networks
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.metrics.classification import CLASSES
from sliplab.analysis.networks import gradients, model_file, training
from sliplab.analysis.networks.models import (
    ModelOnDisk,
    begun,
    comparison_models,
    wanted_models,
)
from sliplab.analysis.report import pages
from sliplab.analysis.report.summary import evaluation_numbers
from sliplab.analysis.trial_work import EachTrial, KeepTrials, in_order
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.protocols.errors import InputError
from sliplab.protocols.network_settings import MOST_CHANNELS
from sliplab.protocols.plugin import plugins
from sliplab.protocols.plugins import import_foreign
from sliplab.storage.files import write_bytes, write_json
from sliplab.storage.interrupts import uninterrupted
from sliplab.storage.schema.model import ModelSamples, TrainedModel, ValidationAccuracy
from sliplab.storage.streams import Json
from sliplab.storage.trials.store import StoreError

Job = Any
"""Everything that an evaluation depends on, found before anything is computed."""
Watch = Callable[[ModelOnDisk], AbstractContextManager[Any]]
"""Shows the training of a model while the block runs; `epoch` of its value takes each epoch."""


@dataclass(frozen=True)
class Workers:
    """What does the work on many trials: this process, or a cluster.

    Attributes:
        each: makes the samples of a part of the split.
        keep: makes and keeps the results of stale trials.
        threads: of a network in one of them; None for as many as there are cores.
    """

    each: Callable[[str], EachTrial]
    keep: KeepTrials
    threads: int | None


@dataclass(frozen=True)
class Problem(ABC):
    """What is to be told apart in the recordings of some campaigns.

    Attributes:
        name: of its evaluation among the results of the step.
        of_slip: its trials are those of slip, which windows, predictions and detectors are about.
        units: of numbers of its own in the table of scores, by key, such as ``{"rmse_n": "N"}``.
        splits: by key of its numbers, the part of the split that they are about.
    """

    name: ClassVar[str]
    of_slip: ClassVar[bool] = False
    units: ClassVar[Mapping[str, str]] = MappingProxyType({})
    splits: ClassVar[Mapping[str, str]] = MappingProxyType({})
    labels: StoreLabels
    campaigns: list[Collected]

    @abstractmethod
    def models(self) -> list[ModelOnDisk]:
        """Return the networks that the settings ask for, with the keys they must have.

        Raises:
            StoreError: a label is missing or stale, or there are no campaigns to train on.
        """

    @abstractmethod
    def samples(self, split: str, each: EachTrial = in_order) -> Any:
        """Return the labelled windows of a part of the split.

        Args:
            each: makes those that are missing.
        """

    def reason_against(self, step: str) -> str | None:
        """Return why a study leaves out a step after collection; None where it can be done."""
        return None

    def check(self) -> None:  # noqa: B027
        """Check that a network can be trained here.

        Raises:
            InputError: there is no such device to train on, or there are too many outputs.
        """

    @abstractmethod
    def train(self, model: ModelOnDisk, train: Any, validation: Any, watch: Watch) -> list[str]:
        """Train a network and keep it; return messages about it.

        Args:
            train, validation: `samples` of these parts.

        Raises:
            StoreError: there are too few samples.
        """

    @abstractmethod
    def job(self, margin: float | None, smoothing: int | None) -> Job:
        """Find the inputs of the evaluation.

        Args:
            margin, smoothing: of the rule, instead of the protocols' own and of chosen ones.

        Raises:
            StoreError: a network or a label is missing or stale.
        """

    @abstractmethod
    def prepare(self, job: Any, workers: Workers) -> Mapping[str, Any]:
        """Make and return what `evaluate` needs of many trials."""

    @abstractmethod
    def evaluate(self, job: Any, parts: Mapping[str, Any]) -> None:
        """Evaluate, and keep one result under the job's key.

        Args:
            parts: of `prepare`.

        Raises:
            StoreError: there are no test samples.
        """

    def others(self) -> Sequence[networks.Judgement]:
        """Return other networks that are judged on the same trials. By default none."""
        return ()

    @abstractmethod
    def baselines(self) -> baselines.Methods:
        """Return ordinary methods on the same windows.

        Raises:
            StoreError: there are no windows of events.
        """

    def numbers(self) -> Json:
        """Return the numbers of the evaluation, under the keys of the report's.

        Raises:
            StoreError: there is no evaluation of this version.
        """
        return evaluation_numbers(self.labels.store, self.campaigns)

    def report_key(self) -> str:
        """Return the key of all inputs of the report.

        Raises:
            StoreError: there is no evaluation of this version, or a label is missing.
        """
        return pages.slip_report_key(self.labels.store, self.campaigns)

    def page(
        self, planned_bytes: Callable[[Collected], int], seconds: Mapping[str, float]
    ) -> pages.Page:
        """Return the report; see `report.pages.slip_page`."""
        return pages.slip_page(self.labels.store, self.campaigns, planned_bytes, seconds)


class EventProblem(Problem):
    """A problem that a spiking network solves on windows of events."""

    @abstractmethod
    def used(self) -> list[Collected]:
        """Return the campaigns whose trials train, choose and test; their windows agree."""

    def check(self) -> None:
        """See `Problem`."""
        item, there = self.used()[0], gradients.devices()
        device = item.settings.training.device
        if device not in there:
            right = f"not available here; must be one of {', '.join(there)}"
            file = item.campaign.protocol_file
            raise InputError(file, "analysis.training.device", device, right)
        network, classes = item.settings.network, self.models()[0].classes or CLASSES
        if network.start == "regression" and (
            (outputs := network.outputs_per_class * len(classes)) > MOST_CHANNELS
        ):
            right = f"gives {outputs} outputs with {len(classes)} classes; {MOST_CHANNELS} at most"
            key, file = "analysis.network.outputs_per_class", item.campaign.protocol_file
            raise InputError(file, key, network.outputs_per_class, right)

    def train(
        self, model: ModelOnDisk, train: SampleSet, validation: SampleSet, watch: Watch
    ) -> list[str]:
        """See `Problem`."""
        for name, part in (("training", train), ("validation", validation)):
            if not len(part):
                raise StoreError(f"there are no {name} samples; collect more trials")
        settings = model.settings
        model.path.parent.mkdir(parents=True, exist_ok=True)
        with watch(model) as display:
            fitted = training.fit(
                train.windows,
                train.y,
                validation.windows,
                validation.y,
                settings.network,
                settings.windows,
                settings.training,
                model.seed,
                on_epoch=display.epoch,
                on_state=partial(write_bytes, model.state_path),
                state=begun(model),
                classes=model.classes or CLASSES,
            )
        samples = ModelSamples(train=len(train), validation=len(validation))
        _keep(model, fitted, samples, simulated=self.labels.store.simulated)
        messages = [f"warning: {warning}" for warning in fitted.warnings]
        if model.classes:
            messages.append(
                f"{model.title}: {len(train)} windows of {len(model.classes)} classes; epoch "
                f"{fitted.chosen_epoch}, validation {100 * fitted.chosen.val_strict:.1f} %"
            )
        return messages


@uninterrupted
def _keep(
    model: ModelOnDisk, fitted: training.Fitted, samples: ModelSamples, *, simulated: bool
) -> None:
    """Write a network and its description, and delete the states of its training."""
    model_file.save(model.path, fitted)
    info = TrainedModel(
        key=model.key,
        seed=model.seed,
        samples=samples,
        chosen_epoch=fitted.chosen_epoch,
        validation=ValidationAccuracy(
            argmax=fitted.chosen.val_argmax,
            strict=fitted.chosen.val_strict,
            margin=fitted.chosen.val_margin,
        ),
        warnings=fitted.warnings,
        simulated=simulated,
    )
    write_json(model.info_path, info.to_json())
    for left in model.path.parent.glob(f"{model.path.stem}.*.state"):
        left.unlink()


class SlipByEvents(EventProblem):
    """No slip, incipient and gross slip, by a spiking network on events."""

    name = evaluation.NAME
    of_slip = True

    def used(self) -> list[Collected]:
        """See `EventProblem`; the kinematic ones."""
        return training_campaigns(self.campaigns)

    def models(self) -> list[ModelOnDisk]:
        """See `Problem`; also those that `analysis.also` names."""
        given = self.labels.store, self.campaigns, self.labels.reviewed
        return [*wanted_models(*given), *comparison_models(*given)]

    def samples(self, split: str, each: EachTrial = in_order) -> SampleSet:
        """See `Problem`."""
        return load_samples(self.labels, self.campaigns, split, each)

    def job(self, margin: float | None, smoothing: int | None) -> evaluation.EvaluationJob:
        """See `Problem`."""
        store, reviewed = self.labels.store, self.labels.reviewed
        self.used()
        return evaluation.make_job(store, self.campaigns, margin, smoothing, reviewed)

    def prepare(self, job: evaluation.EvaluationJob, workers: Workers) -> dict[str, SampleSet]:
        """Count missing spikes, and load training and test samples."""
        store, keep, threads = job.store, workers.keep, workers.threads
        trials = [(item.name, recording, key) for item, _, recording, key in job.trials]
        count_spikes(store, job.model.path, trials, keep, threads)
        for model, item in product(job.others, job.campaigns):
            count_spikes(
                store,
                model.path,
                job.counted_by(model, item),
                keep,
                threads,
                seed_step(model.seed),
                job.detection[item.name].stride_ms,
            )
        predict_trials(store, job.model.path, job.detectors.requests, keep, threads)
        return {split: self.samples(split, workers.each(split)) for split in ("train", "test")}

    def evaluate(self, job: evaluation.EvaluationJob, parts: Mapping[str, SampleSet]) -> None:
        """See `Problem`."""
        evaluation.score_store(job, parts["train"], parts["test"])

    def others(self) -> Sequence[networks.Judgement]:
        """Return the networks that `analysis.also` names.

        Raises:
            StoreError: one is missing or stale.
        """
        return networks.comparison_judgements(self.labels, self.campaigns)

    def baselines(self) -> baselines.Methods:
        """See `Problem`."""
        return baselines.slip_methods()


def problem_of(labels: StoreLabels, campaigns: list[Collected]) -> Problem:
    """Return the problem that campaigns pose: one of a plug-in, where it takes them, or ours.

    Raises:
        InputError: some show classes and some show slip.
        PluginError: one of a plug-in cannot be imported.
    """
    # those that ship come last, so that a package can take what they would
    for place in reversed(plugins().declared("problems").values()):
        if (found := import_foreign(place)(labels, campaigns)) is not None:
            return cast("Problem", found)
    return SlipByEvents(labels, campaigns)


def need_slip(labels: StoreLabels, campaigns: list[Collected]) -> None:
    """See that campaigns pose the problem of slip by events, or by markers.

    Raises:
        StoreError: they pose another one. InputError, PluginError: as `problem_of`.
    """
    found = problem_of(labels, campaigns)
    if found.of_slip:
        return
    raise StoreError(
        f"campaign '{campaigns[0].name}': its recordings show {found.name}, and this is about "
        f"slip; for {found.name} there are `sliplab train`, `evaluate` and `report`"
    )


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Return what was here before; packages of other labs name it."""
        if name == "ClassesOfRecordings":
            return import_foreign("sliplab.plugins.classes.problem:ClassesOfRecordings")
        raise AttributeError(f"module {__name__} has no {name}")
