"""`sliplab report`: `report/index.html` for people; `summary.json`, `scores.parquet` for programs.

Every figure is also written as `report/figures/NAME.svg`, its data as
`report/data/NAME.csv`; the page needs neither, nor anything else.
"""

from __future__ import annotations

from pathlib import Path

from prefect import flow

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.labels.reviewed import StoreLabels
from sliplab.analysis.problem import Problem, problem_of
from sliplab.analysis.report import against as comparison
from sliplab.analysis.report import scores
from sliplab.analysis.report.page import write_figures
from sliplab.analysis.report.sources import STEP, report_folder
from sliplab.flows.planning.size_estimate import plan_bytes
from sliplab.flows.running.orchestration import run
from sliplab.flows.running.run_records import step_seconds, timed
from sliplab.flows.steps import StepResult
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json, write_json, write_text
from sliplab.storage.schema.summary import OneCameraSummary, Summary
from sliplab.storage.streams import Json
from sliplab.storage.trials.catalogue import write_table
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

SUMMARY = "summary.json"


def report(store: TrialStore, campaigns: list[Collected]) -> StepResult:
    """Write the report if anything it shows has changed.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    problem = problem_of(StoreLabels(store), campaigns)
    key = problem.report_key()
    there = [(report_folder(store) / name).exists() for name in ("index.html", scores.FILE)]
    stale = not Derived.of(store, STEP).fresh(STEP, key) or not all(there)
    if stale:
        run(report_flow, problem, key)
    return {"step": "report", "done": int(stale), "fresh": int(not stale)}


@flow(name="report", validate_parameters=False, persist_result=False)
def report_flow(problem: Problem, key: str) -> None:
    """Write the report's page, then its table of scores and its summary."""
    store = problem.labels.store
    folder = report_folder(store)
    folder.mkdir(parents=True, exist_ok=True)
    with timed(store, "report"):
        page = problem.page(_planned_bytes, step_seconds(store))
        write_figures(folder, page.figures, simulated=page.simulated)
        write_text(folder / "index.html", page.html)
    write_scores(problem, page.numbers, folder)
    write_json(folder / SUMMARY, {**page.numbers, "timing_s": step_seconds(store)})
    Derived.of(store, STEP).write(STEP, key, {})


def write_scores(problem: Problem, numbers: Json, folder: Path) -> None:
    """Write a table of scores, with the condition of each trial."""
    conditions = {
        (item.name, trial.id): item.describe(trial)
        for item in problem.campaigns
        for trial, _ in item.trials
    }
    table = scores.score_table(numbers, conditions, problem.units, problem.splits)
    write_table(table, folder / scores.FILE)


def _planned_bytes(item: Collected) -> int:
    """Return the bytes that the committed trials were expected to take; 0 of imported ones."""
    if item.recorded is not None:
        return 0
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    done = {trial.id for trial, _ in item.trials}
    return round(plan_bytes(rig, item.plan, {trial.id for trial in item.plan} - done))


def against(store: TrialStore, other: Path) -> tuple[comparison.ReportComparison, Path]:
    """Compare the last report with another one, and write a page about it.

    Args:
        other: a store with a report, or its ``summary.json``.

    Raises:
        InputError: there is no such report.
    """
    here = comparison.load_report(store.folder, "STORE")
    compared = comparison.compare(here, comparison.load_report(other))
    path = report_folder(store) / comparison.PAGE
    write_text(path, comparison.render(compared, store.folder, other))
    return compared, path


def read_one_camera(store: TrialStore) -> OneCameraSummary | None:
    """Read the numbers of the last report where it is on a rig with one camera; else None."""
    path = report_folder(store) / SUMMARY
    return OneCameraSummary.load(path) if "one_camera" in read_json(path) else None


def read_summary(store: TrialStore) -> Summary:
    """Read the numbers of the last report."""
    return Summary.load(report_folder(store) / SUMMARY)
