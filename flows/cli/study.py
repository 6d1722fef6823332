"""`sliplab study`, `demo` and `holdout`: the whole pipeline from a rig to the report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import (
    ANALYSE,
    CampaignOption,
    JsonOption,
    RigOption,
    StoreArgument,
    opened_campaigns,
)
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.flows.study_defaults import HELD_OUT, LABELS_CHECKED, NETWORKS, study_protocols

if TYPE_CHECKING:
    from sliplab.flows.planning.run_request import RunRequest
    from sliplab.storage.schema.summary import OneCameraSummary, Summary

app = typer.Typer()


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab study my-study --rig mock --pilot")
def study(
    folder: Annotated[Path, typer.Argument(help="The study's store; created if missing.")],
    rig: RigOption = Path("rehearsal"),
    pilot: Annotated[bool, typer.Option("--pilot", help="Use the small pilot protocols.")] = False,
    protocol: Annotated[
        list[Path] | None,
        typer.Option(help="Your own protocol instead of the built-in ones. Repeatable."),
    ] = None,
    extra: Annotated[
        bool, typer.Option(help="Include the 125 % disturbance that the paper left out.")
    ] = True,
    check_labels: Annotated[
        int,
        typer.Option(
            min=0,
            max=1_000_000,
            help="Trials to repeat with video, to check the labels from marker tracks.",
        ),
    ] = LABELS_CHECKED,
    holdout: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=1_000_000,
            help="Trials of the hold-out campaign, evaluated once per version; default: "
            "144 with the protocols that ship, else 0.",
        ),
    ] = None,
    searches: Annotated[
        bool,
        typer.Option(
            "--searches",
            help="Also run baselines, generalisation, sensitivity and trade-off sweeps (hours).",
        ),
    ] = False,
    status: Annotated[
        bool, typer.Option("--status", help="Print the study's progress and exit.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Run the whole pipeline: collect, sync, label, train, evaluate, report. Rerun to resume."""
    if status:
        _status(folder, as_json)
        return
    files = dict.fromkeys(protocol, ()) if protocol else study_protocols(pilot, extra)
    if holdout is None:
        holdout = 0 if pilot or protocol else HELD_OUT
    _chain(folder, files, rig, as_json, check_labels, searches, holdout)


def _status(folder: Path, as_json: bool) -> None:
    """Print the progress of a study."""
    from sliplab.flows.study_ledger import FILE, print_rows, read
    from sliplab.protocols.errors import InputError

    rows = read(folder)
    if not rows:
        raise InputError("FOLDER", "", str(folder), f"is not a study: it has no {FILE}")
    if as_json:
        console.print_json({"steps": [vars(row) for row in rows]})
    else:
        print_rows(rows)


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab demo")
def demo(
    folder: Annotated[Path, typer.Argument(help="Folder for the demo's store.")] = Path(
        "sliplab-demo"
    ),
    rig: RigOption = Path("rehearsal"),
    as_json: JsonOption = False,
) -> None:
    """Run the pilot study on the simulated rig and print the report's path."""
    if rig == Path("rehearsal"):
        console.say(
            "The demo's outside camera delivers simulated marker tracks, no video; "
            "`sliplab demo --rig mock` draws, stores and tracks the video, which takes longer."
        )
    _chain(folder, study_protocols(pilot=True, extra=False), rig, as_json)


def _chain(
    folder: Path,
    protocols: Mapping[Path, tuple[str, ...]],
    rig: Path,
    as_json: bool,
    check: int = 0,
    more: bool = False,
    holdout: int = 0,
) -> None:
    """Run the whole pipeline and print its results."""
    from sliplab.flows.planning.run_request import check_disk, make_request

    run_requests = [make_request(file, rig, folder, enable=on) for file, on in protocols.items()]
    check_disk(run_requests)
    prepare_store(folder)
    from sliplab.flows.report import read_one_camera, read_summary
    from sliplab.flows.study import searches
    from sliplab.flows.study import study as run
    from sliplab.storage.trials.store import TrialStore

    _note_seeds(run_requests)
    outcome = run(run_requests, check, searches(run_requests) if more else (), holdout)
    store = TrialStore.open(folder)
    one_camera = read_one_camera(store)
    summary = read_summary(store) if one_camera is None else one_camera
    page = folder / "report" / "index.html"
    if as_json:
        console.print_json(
            {
                "report": str(page),
                "collected": outcome.collected,
                "steps": outcome.steps,
                "took": [vars(row) for row in outcome.rows],
                "summary": summary.to_json(),
            }
        )
        return
    from sliplab.flows.study_ledger import print_rows

    print_rows(outcome.rows)
    simulated = " (simulated)" if summary.simulated else ""
    console.print_table(f"Results{simulated}", ["figure", "value", "note"], _results(summary))
    console.show(f"Report{simulated}: {page.resolve()}")


@app.command(rich_help_panel=ANALYSE, epilog="Example: sliplab holdout my-study")
def holdout(
    folder: StoreArgument,
    trials: Annotated[
        int,
        typer.Option(
            "--trials", min=2, max=1_000_000, help="Number of trials, spread over the conditions."
        ),
    ] = HELD_OUT,
    again: Annotated[
        bool,
        typer.Option("--again", help="Evaluate even if this version of SlipLab already has."),
    ] = False,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate the network once on a hold-out campaign: another simulated skin and seed."""
    store, campaigns = opened_campaigns(folder, campaign)
    from sliplab.analysis.report.holdout import COLUMNS, holdout_part, holdout_rows
    from sliplab.flows.holdout import measure_holdout

    done = measure_holdout(store, campaigns, trials, again)
    if as_json:
        console.print_json(done)
        return
    rows = holdout_rows(holdout_part(done["result"]))
    console.print_table("hold-out, simulated", COLUMNS, rows)
    file = done["file"]
    console.say(f"stored in {file} with all earlier evaluations; the next report shows it")


def _note_seeds(run_requests: Sequence[RunRequest]) -> None:
    """Warn that too few networks are trained to show the spread over seeds."""
    from sliplab.flows.study import study_plan

    slides = study_plan(run_requests).slides
    trained = len(slides[0].plan.protocol.analysis.training.seeds) if slides else NETWORKS
    if trained < NETWORKS:
        console.say(
            f"Networks of other seeds have other figures, and this study trains {trained}: "
            "`training: {seeds: [0, 1, 2]}` in the protocol shows by how much."
        )


def _results(summary: Summary | OneCameraSummary) -> list[list[str]]:
    """Return the rows of the table of results."""
    from sliplab.analysis.report import one_camera
    from sliplab.analysis.report.report import headline
    from sliplab.storage.schema.summary import Summary

    if not isinstance(summary, Summary):
        return [[item.name, item.value, item.note] for item in one_camera.headline(summary)]
    rows = [[item.name, item.value, item.note] for item in headline(summary)]
    for name, value in summary.kinematic.baselines.items():
        shown = "-" if value is None else f"{100 * value:.1f} %"
        rows.append([f"baseline: {name.replace('_', ' ')}", shown, "argmax, same windows"])
    argmax = summary.kinematic.accuracy.argmax
    rows.append(["network", "-" if argmax is None else f"{100 * argmax:.1f} %", "argmax"])
    return rows
