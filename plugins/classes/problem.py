"""The problem of recordings that show classes: which one does each show?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from sliplab.analysis.campaigns import Collected, agreeing, class_names, of_classes
from sliplab.analysis.evaluation.baselines import Methods
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import ModelOnDisk, choose_model, wanted_models
from sliplab.analysis.problem import EventProblem, Workers
from sliplab.analysis.report import pages
from sliplab.analysis.trial_work import EachTrial, in_order
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_samples
from sliplab.plugins.classes import evaluation, report
from sliplab.plugins.classes.baselines import class_methods
from sliplab.protocols.errors import InputError
from sliplab.storage.streams import Json


class ClassesOfRecordings(EventProblem):
    """Classes that recordings show, by a spiking network on events."""

    name = evaluation.NAME

    def classes(self) -> tuple[str, ...]:
        """Return the names of the classes, by the numbers that samples carry.

        Raises:
            StoreError: there are fewer than two.
        """
        return class_names(self.campaigns)

    def used(self) -> list[Collected]:
        """See `EventProblem`; all."""
        return agreeing(self.campaigns)

    def models(self) -> list[ModelOnDisk]:
        """See `Problem`."""
        return wanted_models(
            self.labels.store, self.campaigns, self.labels.reviewed, self.classes()
        )

    def samples(self, split: str, each: EachTrial = in_order) -> SampleSet:
        """See `Problem`."""
        return load_samples(self.labels, self.campaigns, split, each, self.classes())

    def job(self, margin: float | None, smoothing: int | None) -> evaluation.ClassJob:
        """See `Problem`.

        Raises:
            InputError: a rule of detection is given, which belongs to slip.
        """
        shown = f"sets how slip is detected, and '{self.campaigns[0].name}' shows classes"
        for option, value in (("--margin", margin), ("--smoothing", smoothing)):
            if value is not None:
                raise InputError(option, "", value, f"{shown}; leave it out")
        return evaluation.make_class_job(self.labels, self.campaigns, self.classes(), self.models())

    def prepare(self, job: evaluation.ClassJob, workers: Workers) -> dict[str, SampleSet]:
        """Load the samples of every part of the split."""
        return {split: self.samples(split, workers.each(split)) for split in evaluation.SPLITS}

    def evaluate(self, job: evaluation.ClassJob, parts: Mapping[str, SampleSet]) -> None:
        """See `Problem`."""
        evaluation.evaluate_classes(job, parts)

    def baselines(self) -> Methods:
        """See `Problem`."""
        return class_methods(self.campaigns, len(self.classes()))

    def numbers(self) -> Json:
        """See `Problem`."""
        return report.class_numbers(self.labels.store)

    def report_key(self) -> str:
        """See `Problem`."""
        return report.class_report_key(self.labels.store, self.campaigns)

    def page(
        self, planned_bytes: Callable[[Collected], int], seconds: Mapping[str, float]
    ) -> pages.Page:
        """See `Problem`."""
        store = self.labels.store
        reviewed = evaluation.class_evaluation_of(store).reviewed is not None
        models = replace(self, labels=replace(self.labels, reviewed=reviewed)).models()
        return report.class_page(store, self.campaigns, choose_model(models))


def classes_of_recordings(
    labels: StoreLabels, campaigns: list[Collected]
) -> ClassesOfRecordings | None:
    """Return the problem of campaigns of classes; None of others.

    Raises:
        InputError: some show classes and some show slip.
    """
    return ClassesOfRecordings(labels, campaigns) if of_classes(campaigns) else None
