"""`sliplab sync`, `label`, `train`, `evaluate`, `report`: one analysis step on stored data."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from sliplab.flows.cli.common import (
    ANALYSE,
    CampaignOption,
    DaskOption,
    JsonOption,
    PlaceArgument,
    PromiseOption,
    finish,
    step,
)
from sliplab.flows.cli.model_options import model_options
from sliplab.flows.planning.parameters import RuleOptions
from sliplab.flows.running import console
from sliplab.flows.steps import located, run_step
from sliplab.protocols.errors import InputError
from sliplab.protocols.shown import plural

if TYPE_CHECKING:
    from sliplab.flows.evaluate import PromisedDetector
    from sliplab.flows.judge_detector import JudgedDetector
    from sliplab.flows.judge_network import NetworkScores
    from sliplab.flows.sync import SyncDone
    from sliplab.storage.streams import Json

app = typer.Typer()


class Engine(StrEnum):
    """Engines that count the spikes of a model file."""

    fast = "fast"
    sinabs = "sinabs"


ReviewedOption = Annotated[
    bool, typer.Option("--reviewed", help="Apply the decisions made in `sliplab review`.")
]


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab sync my-store")
def sync(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Refit the clocks of every trial and write report/sync.html."""
    result = cast("SyncDone", run_step(located(store), campaign, "sync", dask))
    if as_json:
        console.print_json(result)
        return
    from sliplab.flows.sync import COLUMNS, tables

    for title, rows in tables(result):
        console.print_table(title, COLUMNS, rows)
    console.show(
        "Median and worst: uncertainty of events against the device, both clocks together; "
        "of events that of their own clock."
    )
    simulated = " (simulated)" if result["simulated"] else ""
    console.show(f"Page{simulated}: {Path(result['page']).resolve()}")


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab label my-store")
def label(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Find the ground-truth onsets of every trial from its video or marker tracks."""
    step(store, campaign, as_json, "label", dask=dask)


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab train my-store")
def train(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    reviewed: ReviewedOption = False,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Train the spiking network on the labelled kinematic trials."""
    step(store, campaign, as_json, "train", dask=dask, reviewed=reviewed)


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab evaluate my-store")
@model_options
def evaluate(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    rule: RuleOptions = RuleOptions(),
    reviewed: ReviewedOption = False,
    baselines: Annotated[
        bool,
        typer.Option("--baselines", help="Also train baseline methods for comparison (minutes)."),
    ] = False,
    checks: Annotated[
        bool, typer.Option("--checks", help="Fail if permuted or shuffled labels reveal a fault.")
    ] = False,
    model: Annotated[
        Path | None,
        typer.Option(
            "--model",
            help="Score this model instead of the store's: a model file, FILE.py:FUNCTION of "
            "another program, or a .json of `sliplab calibrate detector`.",
        ),
    ] = None,
    engine: Annotated[
        Engine | None,
        typer.Option(
            "--engine", help="Engine of a model file; the counts are the same. Default: fast."
        ),
    ] = None,
    predictions: Annotated[
        Path | None,
        typer.Option(
            "--predictions",
            help="Score any model by its predictions of the test windows: a .csv or .parquet "
            "table (docs/models.md).",
        ),
    ] = None,
    promise: PromiseOption = None,
    dask: DaskOption = None,
    as_json: JsonOption = False,
) -> None:
    """Score the network on the test trials."""
    from sliplab.flows.evaluations import run_evaluation

    done = run_evaluation(
        located(store),
        campaign,
        margin=rule.margin,
        smoothing=rule.smoothing,
        reviewed=reviewed,
        baselines=baselines,
        checks=checks,
        model=model,
        engine=None if engine is None else engine.value,
        predictions=predictions,
        dask=dask,
        promise=promise,
    )
    if promise is not None and not as_json:
        _show_promises(done.pop("promise"), store)
    if as_json or (model is None and predictions is None):
        finish(done, f"evaluate {store}", as_json)
        return
    if "detector" in done:
        _show_detector(cast("JudgedDetector", done), store)
        return
    scores = cast("NetworkScores", done)
    simulated = " (simulated)" if scores["simulated"] else ""
    console.print_pairs(f"{scores['model']} on {store}{simulated}", _model_scores(scores))


def _show_promises(rows: list[PromisedDetector], store: str) -> None:
    """Print detectors at the levels that a promise set."""
    from sliplab.analysis.report.page import number

    def rate(found: Json | None) -> str:
        return "" if found is None else f"{found['alarms']} in {found['hours']:.3g} h"

    columns = ["detector", "level", "validation alarms", "test alarms", "median, ms", "promise"]
    table = [
        [
            row["detector"],
            number(row["level"], 2),
            rate(row["validation"]),
            rate(row["test"]),
            number(row["median_ms"], 0),
            "kept" if row["promised"] else "none",
        ]
        for row in rows
    ]
    simulated = " (simulated)" if any(row["simulated"] for row in rows) else ""
    console.print_table(f"detectors at the promise, {store}{simulated}", columns, table)
    for says in dict.fromkeys(row["says"] for row in rows if not row["promised"]):
        console.say(says)


def _show_detector(found: JudgedDetector, store: str) -> None:
    """Print the figures of a calibrated detector."""
    from sliplab.analysis.report.alarms import rate_words
    from sliplab.analysis.report.page import number

    alarms = found["false_alarms"]
    shown = {
        "level": number(found["level"], 2),
        "incipient latency": f"median {number(found['median_ms'], 0)} ms of {found['trials']}; "
        f"{found['missed']} missed, {found['early']} of them false early",
        "false alarms an hour": f"{rate_words(alarms)} in {alarms.hours:.3g} h",
        "promised of holding": f"at most {number(found['promised'], 1)} an hour",
    }
    simulated = " (simulated)" if found["simulated"] else ""
    console.print_pairs(f"{found['detector']} on {store}{simulated}", shown)


def _model_scores(result: NetworkScores) -> dict[str, str | int]:
    """Format the scores of a model in a few lines."""
    from sliplab.analysis.report.alarms import rate_words
    from sliplab.analysis.report.page import number

    accuracy, interval = result["accuracy"], result["interval"]
    sure = ""
    if interval.low is not None and interval.high is not None:
        sure = (
            f" ({interval.low:.1%} to {interval.high:.1%} over {plural(interval.trials, 'trial')})"
        )
    shown: dict[str, str | int] = {
        "windows": f"{accuracy.n} of {plural(interval.trials, 'trial')}",
        "engine": result["engine"],
    }
    if accuracy.n:
        shown |= {
            "strict accuracy": f"{accuracy.strict:.1%}{sure}",
            "argmax accuracy": f"{accuracy.argmax:.1%}",
            "margin accuracy": f"{accuracy.margin:.1%}",
        }
    if (quiet := result["false_alarms"]) is not None:
        shown["false alarms an hour"] = (
            f"{rate_words(quiet)} in quiet holding ({plural(quiet.clusters, 'trial')}, "
            f"{quiet.hours:.3f} h)"
        )
    latency = result["latency_ms"]
    for name, found in (("incipient", latency.incipient), ("gross", latency.gross)):
        if every := found.n + found.missed + found.late:
            shown[f"{name} latency"] = (
                f"median {number(found.median, 0)} ms of {every}; {found.missed} missed, "
                f"{found.late} late, {found.false_early} false early"
            )
    for name, lead in result["lead_ms"].items():
        if lead.median is not None:
            shown[f"{name} lead"] = f"median {lead.median:.0f} ms of {lead.n}"
    return shown


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab report my-store")
def report(
    store: PlaceArgument,
    campaign: CampaignOption = None,
    against: Annotated[
        Path | None,
        typer.Option("--against", help="Another store or its summary.json to compare with."),
    ] = None,
    since: Annotated[
        str | None,
        typer.Option("--since", help="Report what happened from this day on: 2026-11-22."),
    ] = None,
    until: Annotated[
        str | None, typer.Option("--until", help="Its last day; default: the current one.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Write report/index.html and report/summary.json, and compare with another report.

    With --since, write report/periods/ instead: trials, drift, forecasts and what people did.
    """
    folder = located(store)
    if since is not None or until is not None:
        if campaign or against is not None:
            option = "--against" if against is not None else "--campaign"
            raise InputError(option, "", None, "cannot be combined with --since and --until")
        _report_period(folder, since, until, as_json)
        return
    if against is not None:
        from sliplab.analysis.report.against import load_report

        load_report(against)  # wrong input fails before anything is made
    done: dict[str, object] = {**run_step(folder, campaign, "report")}
    if against is not None:
        from sliplab.analysis.report.against import short_table
        from sliplab.flows import report as reports
        from sliplab.storage.remote.mirror import open_store

        compared, page = reports.against(open_store(folder), against)
        if as_json:
            done["against"] = {**compared.to_json(), "page": str(page)}
        else:
            title = "Two reports" + (" (simulated)" if any(compared.simulated) else "")
            console.print_table(title, *short_table(compared.figures))
            console.show(f"Page: {page}")
    finish(done, f"report {store}", as_json)
    console.say(f"report: {folder / 'report' / 'index.html'}")


def _report_period(folder: Path, since: str | None, until: str | None, as_json: bool) -> None:
    from datetime import datetime

    from sliplab.flows.period import days, write_period_report
    from sliplab.storage.files import read_json
    from sliplab.storage.remote.mirror import open_store

    now = datetime.now().astimezone()
    page = write_period_report(open_store(folder), *days(since, until, now), now)
    if as_json:
        console.print_json({**read_json(page.with_suffix(".json")), "page": str(page)})
    else:
        console.show(f"Page: {page}")
