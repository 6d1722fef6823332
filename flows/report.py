"""`sliplab report`: `report/index.html` for people and `report/summary.json` for programs.

Every figure is also written as `report/figures/NAME.svg`, its data as
`report/data/NAME.csv`; the page needs neither, nor anything else.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from prefect import flow

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.detectors.predictions import trial_counts
from sliplab.analysis.evaluation import baselines as window_baselines
from sliplab.analysis.evaluation import networks as other_networks
from sliplab.analysis.evaluation import windows as window_scores
from sliplab.analysis.evaluation.evaluation import evaluation_of
from sliplab.analysis.labels import label_errors
from sliplab.analysis.networks import model_file
from sliplab.analysis.networks.models import choose_model, training_settings, wanted_models
from sliplab.analysis.report import against as comparison
from sliplab.analysis.report import report as content
from sliplab.analysis.report.clocks import PAGE as CLOCKS
from sliplab.analysis.report.page import write_figures
from sliplab.analysis.report.programs import read_programs
from sliplab.analysis.report.summary import Sources, make_summary
from sliplab.analysis.report.trial import choose_example
from sliplab.flows.planning.estimate import plan_bytes
from sliplab.flows.running.orchestration import Opaque, run
from sliplab.flows.running.run_records import step_seconds, timed
from sliplab.rigs.rig_file import load_rig_file
from sliplab.storage.files import write_json, write_text
from sliplab.storage.schema.summary import Summary
from sliplab.storage.trials.derived import Derived, make_key
from sliplab.storage.trials.store import Store

STEP = "report"
VERSION = 10
SUMMARY = "summary.json"


def report_folder(store: Store) -> Path:
    """Return the folder of the report."""
    return store.folder / "report"


def report(store: Store, campaigns: list[Collected]) -> dict[str, Any]:
    """Write the report if anything it shows has changed.

    Raises:
        StoreError: there is no evaluation of this version yet.
    """
    key = _key(store, campaigns)
    page = report_folder(store) / "index.html"
    stale = not Derived.of(store, STEP).fresh(STEP, key) or not page.exists()
    if stale:
        run(report_flow, Opaque((store, campaigns, key)))
    return {"step": "report", "done": int(stale), "fresh": int(not stale)}


def _key(store: Store, campaigns: list[Collected]) -> str:
    """Return the key of all that the report is made of."""
    evaluation = evaluation_of(store)
    collected = [
        [
            item.name,
            item.plan.collection_hash,
            len(item.campaign.quarantined()),
            [recording.checksum for _, recording in item.trials],
        ]
        for item in campaigns
    ]
    reviewed = evaluation.reviewed is not None
    others = other_networks.kept(store, campaigns, reviewed).values()
    inputs = [
        evaluation.key,
        collected,
        (report_folder(store) / CLOCKS).exists(),
        sorted(found.key for found in others),
        window_baselines.fresh_keys(store),
        read_programs(store),
        Derived.of(store, label_errors.CHECK).key(label_errors.CHECK),
        # commands in the page name the store's folder
        str(store.folder.resolve()),
    ]
    return make_key(STEP, VERSION, inputs, None)


@flow(name="report", validate_parameters=False, persist_result=False)
def report_flow(argument: Opaque[tuple[Store, list[Collected], str]]) -> None:
    """Write page and summary; the summary last, with the key."""
    store, campaigns, key = argument.content
    folder = report_folder(store)
    folder.mkdir(parents=True, exist_ok=True)
    with timed(store, "report"):
        sources = _sources(store, campaigns)
        summary = make_summary(sources)
        sections = content.make_sections(sources, summary, _shown(sources))
        write_figures(folder, sections, simulated=summary.simulated)
        write_text(folder / "index.html", content.render(sources, summary, sections))
    final = {**summary.to_json(), "timing_s": step_seconds(store)}
    write_json(folder / SUMMARY, final)
    Derived.of(store, STEP).write(STEP, key, {})


def _sources(store: Store, campaigns: list[Collected]) -> Sources:
    """Read what earlier steps kept."""
    evaluation = evaluation_of(store)
    return Sources(
        store,
        campaigns,
        settings=training_settings(campaigns),
        evaluation=evaluation,
        networks=other_networks.kept(store, campaigns, evaluation.reviewed is not None),
        baselines=window_baselines.baselines(store),
        window_intervals=window_scores.window_intervals(store, evaluation.key),
        label_check=label_errors.read_check(store),
        holds=label_errors.holds_compared(store, campaigns),
        planned_bytes={item.name: _planned_bytes(item) for item in campaigns},
        step_seconds=step_seconds(store),
        programs=read_programs(store),
    )


def _planned_bytes(item: Collected) -> int:
    """Return the bytes that the committed trials were expected to take."""
    rig, _ = load_rig_file(item.campaign.folder / "rig.yaml", stored=True)
    done = {trial.id for trial, _ in item.trials}
    return round(plan_bytes(rig, item.plan, {trial.id for trial in item.plan} - done))


def _shown(sources: Sources) -> content.Shown:
    """Read what the page shows besides the summary's numbers."""
    store, campaigns, evaluation = sources.store, list(sources.campaigns), sources.evaluation
    models = wanted_models(store, campaigns, evaluation.reviewed is not None)
    model = choose_model(models)
    example = choose_example(campaigns, evaluation.trials)
    counts: dict[str, Any] = {}
    if example is not None:
        rule = evaluation.detection[example.item.name]
        trial = example.recording.trial_id
        counts = trial_counts(store, example.item.name, trial, rule)
    return content.Shown(
        model_file.load(model.path),
        None if example is None else (example, counts),
        label_errors.distances(store, campaigns),
    )


def against(store: Store, other: Path) -> tuple[comparison.Comparison, Path]:
    """Compare the last report with another one, and write a page about it.

    Args:
        other: a store with a report, or its ``summary.json``.

    Raises:
        InputError: there is no such report.
    """
    compared = comparison.compare(read_summary(store), comparison.load_other(other))
    path = report_folder(store) / comparison.PAGE
    write_text(path, comparison.render(compared, store.folder, other))
    return compared, path


def read_summary(store: Store) -> Summary:
    """Read the numbers of the last report."""
    return Summary.load(report_folder(store) / SUMMARY)
