"""`sliplab report`: `report/index.html` for people; `summary.json`, `scores.parquet` for programs.

Every figure is also written as `report/figures/NAME.svg`, its data as
`report/data/NAME.csv`; the page needs neither, nor anything else.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from prefect import flow

from sliplab.analysis.campaigns import Collected, missing_stream, of_classes
from sliplab.analysis.report import against as comparison
from sliplab.analysis.report import classes, one_camera, scores
from sliplab.analysis.report import report as content
from sliplab.analysis.report.marker_network import read_judged
from sliplab.analysis.report.page import write_figures
from sliplab.analysis.report.sources import STEP, read_sources, report_folder, report_key
from sliplab.analysis.report.summary import make_summary
from sliplab.flows.classes import write_class_page
from sliplab.flows.planning.estimate import plan_bytes
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import step_seconds, timed
from sliplab.flows.steps import StepResult
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import read_json, write_json, write_text
from sliplab.storage.schema.summary import OneCameraSummary, Summary
from sliplab.storage.streams import Json
from sliplab.storage.trials.catalogue import write_table
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import Store

SUMMARY = "summary.json"


def report(store: Store, campaigns: list[Collected]) -> StepResult:
    """Write the report if anything it shows has changed.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    if of_classes(campaigns):
        key = classes.class_report_key(store, campaigns)
    elif missing_stream(campaigns) is not None:
        key = one_camera.one_camera_key(store, campaigns)
    else:
        key = report_key(store, campaigns)
    there = [(report_folder(store) / name).exists() for name in ("index.html", scores.FILE)]
    stale = not Derived.of(store, STEP).fresh(STEP, key) or not all(there)
    if stale:
        run(report_flow, Opaque((store, campaigns, key)))
    return {"step": "report", "done": int(stale), "fresh": int(not stale)}


@flow(name="report", validate_parameters=False, persist_result=False)
def report_flow(argument: Opaque[tuple[Store, list[Collected], str]]) -> None:
    """Write the report's page, then its table of scores and its summary."""
    store, campaigns, key = argument.content
    folder = report_folder(store)
    folder.mkdir(parents=True, exist_ok=True)
    with timed(store, "report"):
        if of_classes(campaigns):
            numbers = write_class_page(store, campaigns)
        else:
            numbers = _write_page(store, campaigns)
    conditions = {
        (item.name, trial.id): item.describe(trial)
        for item in campaigns
        for trial, _ in item.trials
    }
    write_table(scores.score_table(numbers, conditions), folder / scores.FILE)
    write_json(folder / SUMMARY, {**numbers, "timing_s": step_seconds(store)})
    Derived.of(store, STEP).write(STEP, key, {})


def _write_page(store: Store, campaigns: list[Collected]) -> Json:
    """Write the page about slip; return its numbers."""
    folder = report_folder(store)
    planned = {item.name: _planned_bytes(item) for item in campaigns}
    missing = missing_stream(campaigns)
    if missing is None:
        return _evaluated(store, campaigns, planned)
    judged = read_judged(store, campaigns) if missing == "events" else None
    shown = one_camera.one_camera_summary(store, campaigns, planned, judged)
    if one_camera.is_evaluated(store, campaigns):
        return shown.to_json() | _evaluated(store, campaigns, planned, shown)
    parts = one_camera.one_camera_sections(store, campaigns, shown, judged)
    write_figures(folder, parts, simulated=shown.simulated)
    write_text(folder / "index.html", one_camera.render(campaigns, shown, parts))
    return shown.to_json()


def _evaluated(
    store: Store,
    campaigns: list[Collected],
    planned: Mapping[str, int],
    without_frames: OneCameraSummary | None = None,
) -> Json:
    """Write the page, and return the numbers, of campaigns with a spiking network.

    Args:
        without_frames: summary of a study without frames; adds its sections to the page.
    """
    folder = report_folder(store)
    sources = read_sources(store, campaigns, planned, step_seconds(store))
    summary = make_summary(sources)
    sections = content.make_sections(sources, summary, content.read_shown(sources))
    if without_frames is not None:
        rates = one_camera.rate_section(campaigns, without_frames)
        sections = [one_camera.left_out_section(without_frames), *sections]
        sections += [] if rates is None else [rates]
    write_figures(folder, sections, simulated=summary.simulated)
    write_text(folder / "index.html", content.render(sources, summary, sections))
    return summary.to_json()


def _planned_bytes(item: Collected) -> int:
    """Return the bytes that the committed trials were expected to take; 0 of imported ones."""
    if item.recorded is not None:
        return 0
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    done = {trial.id for trial, _ in item.trials}
    return round(plan_bytes(rig, item.plan, {trial.id for trial in item.plan} - done))


def against(store: Store, other: Path) -> tuple[comparison.ReportComparison, Path]:
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


def read_one_camera(store: Store) -> OneCameraSummary | None:
    """Read the numbers of the last report where it is on a rig with one camera; else None."""
    path = report_folder(store) / SUMMARY
    return OneCameraSummary.load(path) if "one_camera" in read_json(path) else None


def read_summary(store: Store) -> Summary:
    """Read the numbers of the last report."""
    return Summary.load(report_folder(store) / SUMMARY)
