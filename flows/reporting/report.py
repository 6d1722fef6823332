"""The report: `report/index.html` for people and `report/summary.json` for programs.

Every figure also stands beside them as `report/figures/NAME.svg`, its data as
`report/data/NAME.csv`; the page needs neither, nor anything else.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefect import flow

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.networks import model_file
from sliplab.analysis.report import page
from sliplab.flows.labelling import label_errors
from sliplab.flows.learning import evaluate, other_networks
from sliplab.flows.learning.train import wanted_models
from sliplab.flows.learning.window_baselines import fresh_keys
from sliplab.flows.reporting import report_against_page as against_page
from sliplab.flows.reporting import sections
from sliplab.flows.reporting.report_against import compare, load_other
from sliplab.flows.reporting.report_extras import extras
from sliplab.flows.reporting.summary import make_summary
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import step_seconds, timed
from sliplab.flows.syncing.sync_page import PAGE as CLOCKS
from sliplab.storage.files import make_folder, read_json, safe_name, write_json, write_text
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

STEP = "report"
VERSION = 10


def report_folder(store: Store) -> Path:
    """Where the report stands."""
    return store.folder / "report"


def _key(store: Store, campaigns: list[Collected]) -> str:
    """What the report is made of: the evaluation, all that was collected, a page to link to.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    evaluated, evaluation = evaluate.evaluation_of(store)
    collected = [
        [
            item.name,
            item.plan.collection_hash,
            len(item.campaign.quarantined()),
            [recording.checksum for _, recording in item.trials],
        ]
        for item in campaigns
    ]
    clocks = (report_folder(store) / CLOCKS).exists()
    # commands in the page name the store's folder
    where = str(store.folder.resolve())
    checked = Derived.of(store, label_errors.CHECK).key(label_errors.CHECK)
    reviewed = evaluation.get("reviewed") is not None
    others = sorted(
        found["key"] for found in other_networks.kept(store, campaigns, reviewed).values()
    )
    inputs = [
        evaluated,
        collected,
        clocks,
        others,
        fresh_keys(store),
        extras(store),
        checked,
        where,
    ]
    return make_key(STEP, VERSION, inputs, None)


@flow(name="report", validate_parameters=False, persist_result=False)
def report_flow(wanted: Opaque[tuple[Store, list[Collected], str]]) -> None:
    """Write page and summary; the summary last, with the key."""
    store, campaigns, key = wanted.content
    folder = report_folder(store)
    folder.mkdir(parents=True, exist_ok=True)
    with timed(store, "report"):
        _, evaluation = evaluate.evaluation_of(store)
        model = evaluate.choose_model(
            wanted_models(store, campaigns, evaluation.get("reviewed") is not None)
        )
        fitted = model_file.load(model.path)
        others = extras(store)
        summary = make_summary(store, campaigns, evaluation, others.get("holdout"))
        made = sections.make_sections(
            sections.Material(store, campaigns, evaluation, summary, fitted, others)
        )
        write_figures(folder, made, simulated=summary["simulated"])
        html = page.render(
            [item.name for item in campaigns],
            sections.headline(summary),
            made,
            simulated=summary["simulated"],
        )
        write_text(folder / "index.html", html)
    summary["timing_s"] = step_seconds(store)
    write_json(folder / "summary.json", summary)
    Derived.of(store, STEP).write(STEP, key, {})


def write_figures(folder: Path, made: Sequence[page.Section], *, simulated: bool) -> None:
    """Each named figure and its data as files of their own; those of an older report go.

    Raises:
        ValueError: two figures of one name.
    """
    named = [figure for section in made for figure in section.figures if figure.name]
    if len({figure.name for figure in named}) < len(named):
        raise ValueError(f"two figures of one name among {[figure.name for figure in named]}")
    kept: set[Path] = set()
    for figure in named:
        name = safe_name(figure.name)
        files = {
            folder / "figures" / f"{name}.svg": figure.svg,
            folder / "data" / f"{name}.csv": page.csv_text(figure.data, simulated=simulated),
        }
        for path, text in files.items():
            make_folder(path.parent)
            write_text(path, text)
            kept.add(path)
    for old in (*(folder / "figures").glob("*.svg"), *(folder / "data").glob("*.csv")):
        if old not in kept:
            old.unlink()


def report(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """Write the report if anything it shows has changed."""
    key = _key(store, campaigns)
    stale = (
        not Derived.of(store, STEP).fresh(STEP, key)
        or not (report_folder(store) / "index.html").exists()
    )
    if stale:
        run(report_flow, Opaque((store, campaigns, key)))
    return {"step": "report", "done": int(stale), "fresh": int(not stale)}


def against(store: Store, other: Path) -> dict[str, Any]:
    """Hold the last report against another one, and write `report/against.html` about it.

    Args:
        other: a store with a report, or its ``summary.json``.

    Raises:
        InputError: there is no such report.
    """
    theirs = load_other(other)
    compared = compare(read_summary(store), theirs)
    path = report_folder(store) / against_page.PAGE
    write_text(path, against_page.render(compared, store.folder, other))
    return {**compared, "page": str(path)}


def read_summary(store: Store) -> dict[str, Any]:
    """The numbers of the last report."""
    return read_json(report_folder(store) / "summary.json")
