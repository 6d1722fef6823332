"""The problem of a rig without events: slip, by the displacements of markers in frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from sliplab.analysis.campaigns import Collected, missing_stream, of_classes, training_campaigns
from sliplab.analysis.evaluation import baselines
from sliplab.analysis.evaluation.evaluation import NAME
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.networks.models import ModelOnDisk
from sliplab.analysis.problem import Problem, Watch, Workers
from sliplab.analysis.report import one_camera, pages
from sliplab.analysis.trial_work import EachTrial, in_order
from sliplab.plugins.markers import evaluation, section
from sliplab.plugins.markers.displacement import MarkerSamples, load_marker_samples
from sliplab.storage.schema.summary import OneCameraSummary
from sliplab.storage.streams import Json


class SlipByMarkers(Problem):
    """No slip, incipient and gross slip, by a classifier on marker displacements."""

    name = NAME
    of_slip = True

    def reason_against(self, step: str) -> str | None:
        """See `Problem`; searches and hold-outs run a spiking network."""
        if step not in {"sync", "label", "train", "evaluate", "report"}:
            return "works with the spiking network on events, and there are none"
        slides = any(item.experiment == "kinematic" for item in self.campaigns)
        if step in {"train", "evaluate"} and not slides:
            return (
                "the classifier is trained on slides, and without events nothing else is evaluated"
            )
        return None

    def models(self) -> list[ModelOnDisk]:
        """See `Problem`."""
        return evaluation.wanted_marker_models(self.labels, self.campaigns)

    def samples(self, split: str, each: EachTrial = in_order) -> MarkerSamples:
        """See `Problem`; they take seconds on this machine."""
        return load_marker_samples(self.labels, self.campaigns, split)

    def train(
        self, model: ModelOnDisk, train: MarkerSamples, validation: MarkerSamples, watch: Watch
    ) -> list[str]:
        """See `Problem`."""
        simulated = self.labels.store.simulated
        net = evaluation.train_marker_model(model, train, validation, simulated=simulated)
        strict = model.info.validation.strict
        shown = "" if strict is None else f", validation {100 * strict:.1f} %"
        return [f"{model.title}: {net.title}; epoch {net.chosen_epoch}{shown}"]

    def job(self, margin: float | None, smoothing: int | None) -> evaluation.MarkerJob:
        """See `Problem`."""
        return evaluation.make_marker_job(self.labels, self.campaigns, margin, smoothing)

    def prepare(self, job: evaluation.MarkerJob, workers: Workers) -> dict[str, Any]:
        """See `Problem`; nothing is needed."""
        return {}

    def evaluate(self, job: evaluation.MarkerJob, parts: Mapping[str, Any]) -> None:
        """See `Problem`."""
        evaluation.evaluate_markers(job)

    def numbers(self) -> Json:
        """See `Problem`."""
        nothing = {item.name: 0 for item in self.campaigns}
        numbers = self._summary(nothing, self._judged()).to_json()
        del numbers["planned"]  # that of a report alone
        return numbers

    def report_key(self) -> str:
        """See `Problem`."""
        judged = self._judged()
        evaluations = () if judged is None else (judged.evaluation.key,)
        return one_camera.one_camera_key(self.labels.store, self.campaigns, evaluations)

    def page(
        self, planned_bytes: Callable[[Collected], int], seconds: Mapping[str, float]
    ) -> pages.Page:
        """See `Problem`."""
        store, campaigns, judged = self.labels.store, self.campaigns, self._judged()
        planned = {item.name: planned_bytes(item) for item in campaigns}
        summary = self._summary(planned, judged)
        own = () if judged is None else section.marker_sections(store, campaigns, summary, judged)
        sections = one_camera.one_camera_sections(store, campaigns, summary, own)
        cover = one_camera.one_camera_cover(summary)
        return pages.make_page(campaigns, summary.to_json(), cover, sections)

    def _judged(self) -> section.EvaluatedClassifier | None:
        return section.read_judged(self.labels.store, self.campaigns)

    def _summary(
        self, planned: Mapping[str, int], judged: section.EvaluatedClassifier | None
    ) -> OneCameraSummary:
        store, campaigns, evaluated = self.labels.store, self.campaigns, judged is not None
        summary = one_camera.one_camera_summary(store, campaigns, planned, evaluated=evaluated)
        if judged is None:
            return summary
        return section.with_classifier(summary, store, campaigns, judged)

    def baselines(self) -> baselines.Methods:
        """See `Problem`."""
        training_campaigns(self.campaigns)  # raises
        return baselines.slip_methods()


def slip_by_markers(labels: StoreLabels, campaigns: list[Collected]) -> SlipByMarkers | None:
    """Return the problem of campaigns without events; None of others."""
    if of_classes(campaigns) or missing_stream(campaigns) != "events":
        return None
    return SlipByMarkers(labels, campaigns)
