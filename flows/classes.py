"""Evaluation, and the page about it, of recordings that show other classes than slip's."""

from __future__ import annotations

from typing import TYPE_CHECKING

from prefect import flow, task
from prefect.cache_policies import NO_CACHE

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.evaluation.classes import (
    NAME,
    SPLITS,
    ClassJob,
    evaluate_classes,
    make_class_job,
)
from sliplab.analysis.evaluation.evaluation import STEP
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.report import classes as content
from sliplab.analysis.report.page import write_figures
from sliplab.analysis.report.sources import report_folder
from sliplab.analysis.windows.dataset import SampleSet
from sliplab.analysis.windows.sample_sets import load_class_samples
from sliplab.flows.label import report_states
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import timed
from sliplab.flows.steps import StepResult
from sliplab.flows.train import sample_maker
from sliplab.protocols.errors import InputError
from sliplab.storage.files import write_text
from sliplab.storage.streams import Json
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

if TYPE_CHECKING:
    from sliplab.flows.running.cluster import Cluster


def evaluate_on_classes(
    store: Store,
    campaigns: list[Collected],
    margin: float | None = None,
    smoothing: int | None = None,
    cluster: Cluster | None = None,
    reviewed: bool = False,
) -> StepResult:
    """Evaluate if any input changed; see `evaluate.evaluate`.

    Raises:
        InputError: a rule of detection is given, which belongs to slip.
    """
    for option, value in (("--margin", margin), ("--smoothing", smoothing)):
        if value is not None:
            raise InputError(
                option,
                "",
                value,
                f"sets how slip is detected, and '{campaigns[0].name}' shows classes; leave it out",
            )
    job = make_class_job(StoreLabels(store, reviewed), campaigns)
    stale = not Derived.of(store, STEP).fresh(NAME, job.key)
    if stale:
        run(evaluate_classes_flow, Opaque((job, cluster)), cluster)
    return {
        "step": "evaluate",
        "done": int(stale),
        "fresh": int(not stale),
        **report_states(job.labels, campaigns),
    }


@flow(name="evaluate classes", validate_parameters=False, persist_result=False)
def evaluate_classes_flow(argument: Opaque[tuple[ClassJob, Cluster | None]]) -> None:
    """Make the missing samples, then evaluate the classes."""
    job, cluster = argument.content
    store = job.labels.store
    with timed(store, "evaluate"):
        parts = {
            split: load_class_samples(
                job.labels, job.campaigns, split, sample_maker(store, split, cluster)
            )
            for split in SPLITS
        }
        score_classes(Opaque((job, parts)))


@task(name="scores of classes", cache_policy=NO_CACHE, persist_result=False)
def score_classes(argument: Opaque[tuple[ClassJob, dict[str, SampleSet]]]) -> None:
    """Evaluate windows, recordings and classes, and store one result."""
    evaluate_classes(*argument.content)


def write_class_page(store: Store, campaigns: list[Collected]) -> Json:
    """Write the page about recordings of classes; return its numbers.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    folder = report_folder(store)
    summary = content.class_summary(store, campaigns)
    sections = content.class_sections(store, campaigns, summary)
    write_figures(folder, sections, simulated=summary.simulated)
    write_text(folder / "index.html", content.render(campaigns, summary, sections))
    return summary.to_json()
