"""`sliplab tradeoff`: what accuracy costs, of a simulated scene or of the detector."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from sliplab.flows.cli.common import CampaignOption, DaskOption, JsonOption, located
from sliplab.flows.cli.steps import ReviewedOption
from sliplab.flows.running import console
from sliplab.flows.steps import prepare_store
from sliplab.protocols.errors import InputError

SCENE_OUT = Path("sliplab-tradeoff")


def tradeoff(
    scene: Annotated[
        Path | None, typer.Option("--scene", help="The protocol whose scene is simulated (YAML).")
    ] = None,
    detector: Annotated[
        str | None, typer.Option("--detector", help="A labelled store whose detector is varied.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"Folder for page and numbers; {SCENE_OUT} or the store's report/ by default.",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials",
            min=1,
            max=1_000_000,
            help="Trials to simulate (4); or validation and test trials to judge by (60 each).",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Scene: a rig file or name; mock by default.")
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Scene: also what each guessed number changes.")
    ] = False,
    dask: DaskOption = None,
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples",
            min=3,
            max=1_000_000_000,
            help="Detector: windows of each training (12000).",
        ),
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, max=10_000, help="Detector: of each training (4)."),
    ] = None,
    seeds: Annotated[
        int | None, typer.Option("--seeds", min=1, max=1000, help="Detector: of each setting (3).")
    ] = None,
    stride: Annotated[
        int | None,
        typer.Option("--stride", min=1, max=1000, help="Detector: the finest stride, ms (10)."),
    ] = None,
    length: Annotated[
        list[int] | None,
        typer.Option("--length", min=0, max=10_000, help="Detector: a window length, ms; again."),
    ] = None,
    step: Annotated[
        list[int] | None,
        typer.Option("--step", min=0, max=10_000, help="Detector: a step, ms; again."),
    ] = None,
    pool: Annotated[
        list[int] | None,
        typer.Option("--pool", min=0, max=10_000, help="Detector: a cell's side, px; again."),
    ] = None,
    width: Annotated[
        list[float] | None,
        typer.Option("--width", min=0, max=1000, help="Detector: a factor on channels; again."),
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Detector: every value with every other.")
    ] = False,
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes",
            min=0,
            max=100_000,
            help="Detector: begin no training after so many; 0: only the page.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Detector: only say what is to do and how long.")
    ] = False,
    campaign: CampaignOption = None,
    reviewed: ReviewedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure what accuracy costs: of simulating a scene, or of the detector on a store."""
    if (scene is None) == (detector is None):
        raise InputError(
            "--scene", "", None, "give exactly one of --scene PROTOCOL and --detector STORE"
        )
    of_detector = {
        "--samples": samples, "--epochs": epochs, "--seeds": seeds, "--stride": stride,
        "--length": length, "--step": step, "--pool": pool, "--width": width, "--full": full,
        "--minutes": minutes, "--dry-run": dry_run, "--campaign": campaign,
        "--reviewed": reviewed,
    }  # fmt: skip
    of_scene = {"--rig": rig, "--sensitivity": sensitivity, "--dask": dask}
    if scene is not None:
        _refuse(of_detector, "--detector")
        _scene(
            scene, rig or Path("mock"), out or SCENE_OUT, trials or 4, sensitivity, dask, as_json
        )
        return
    _refuse(of_scene, "--scene")
    assert detector is not None
    how = {"samples": samples, "epochs": epochs, "trials": trials, "seeds": seeds}
    axes = {"length_ms": length, "step_ms": step, "pool_px": pool, "width": width}
    options = {"full": full, "reviewed": reviewed, "minutes": minutes, "dry_run": dry_run}
    _detector(detector, out, {**how, "stride_ms": stride}, axes, campaign, options, as_json)


def _refuse(options: dict[str, Any], other: str) -> None:
    for name, value in options.items():
        if value not in (None, False):
            raise InputError(name, "", None, f"belongs to {other}")


def _scene(
    scene: Path,
    rig: Path,
    out: Path,
    trials: int,
    sensitivity: bool,
    dask: str | None,
    as_json: bool,
) -> None:
    from sliplab.flows.searching import tradeoff as steps
    from sliplab.flows.searching.tradeoff_page import choice_pairs, short_table

    result = steps.tradeoff(scene, rig, out, trials, sensitivity, dask=dask)
    if as_json:
        console.print_json(result)
        return
    title = f"Cost and error of the scene of {result['protocol']} (simulated)"
    console.print_table(title, *short_table(result))
    console.print_pairs("The level that the protocol needs", choice_pairs(result))
    console.show(f"Page (simulated): {(out / steps.PAGE).resolve()}")


def _detector(
    place: str,
    out: Path | None,
    how: dict[str, Any],
    axes: dict[str, Any],
    campaign: list[str] | None,
    options: dict[str, Any],
    as_json: bool,
) -> None:
    from sliplab.storage.remote.mirror import open_store

    folder = located(place)
    store = open_store(folder)
    prepare_store(folder)
    from sliplab.analysis.campaigns import collected
    from sliplab.analysis.report.tradeoff_detector import short_table
    from sliplab.analysis.sweeps.detector_grid import Axes
    from sliplab.analysis.sweeps.detector_search import SearchSize
    from sliplab.flows import tradeoff as steps

    asked = SearchSize(**{name: value for name, value in how.items() if value is not None})
    given = Axes(**{name: tuple(sorted(set(each))) for name, each in axes.items() if each})
    target = folder / "report" if out is None else out
    result = steps.tradeoff_detector(
        store, collected(store, campaign), target, asked, given, **options
    )
    if as_json:
        console.print_json(result)
        return
    simulated = " (simulated)" if result["simulated"] else ""
    if "rows" not in result:
        shown = {key: result[key] for key in ("runs", "kept", "pending", "estimated_s")}
        console.print_pairs(f"tradeoff --detector {place}{simulated}", shown)
        return
    console.print_table(
        f"The quickest detectors by false early trials{simulated}", *short_table(result)
    )
    console.show("Network: window ms/step ms/cell px/width; rule: windows, spikes.")
    console.show(f"Page{simulated}: {(target / steps.DETECTOR_PAGE).resolve()}")


def register(app: typer.Typer) -> None:
    """Make it a command of `app`."""
    app.command()(tradeoff)
