"""`sliplab tradeoff`, `generalise` and `guesses`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import (
    CampaignOption,
    DaskOption,
    JsonOption,
    StoreArgument,
    located,
    opened_campaigns,
)
from sliplab.flows.cli.steps import ReviewedOption
from sliplab.flows.running import console
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.plugins.studies.detector.grid import Axes

SCENE_OUT = Path("sliplab-tradeoff")

app = typer.Typer()


@app.command(epilog="Example: sliplab tradeoff --detector my-study")
def tradeoff(
    scene: Annotated[
        Path | None, typer.Option("--scene", help="The protocol whose scene is simulated (YAML).")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option("--detector", help="A labelled store whose detector settings are varied."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help=f"Output folder; default: {SCENE_OUT} or the store's report/.",
        ),
    ] = None,
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials",
            min=1,
            max=1_000_000,
            help="Scene: trials to simulate (4). Detector: validation and test trials (60 each).",
        ),
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Scene: a rig file or name; default: mock.")
    ] = None,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Scene: also vary each assumed parameter.")
    ] = False,
    dask: DaskOption = None,
    samples: Annotated[
        int | None,
        typer.Option(
            "--samples",
            min=3,
            max=1_000_000_000,
            help="Detector: windows per training (12000).",
        ),
    ] = None,
    epochs: Annotated[
        int | None,
        typer.Option("--epochs", min=1, max=10_000, help="Detector: epochs per training (4)."),
    ] = None,
    seeds: Annotated[
        int | None,
        typer.Option("--seeds", min=1, max=1000, help="Detector: seeds per setting (3)."),
    ] = None,
    stride: Annotated[
        int | None,
        typer.Option("--stride", min=1, max=1000, help="Detector: the smallest stride, ms (10)."),
    ] = None,
    length: Annotated[
        list[int] | None,
        typer.Option(
            "--length",
            min=0,
            max=10_000,
            help="Detector: window length, ms. Repeatable.",
        ),
    ] = None,
    step: Annotated[
        list[int] | None,
        typer.Option("--step", min=0, max=10_000, help="Detector: time step, ms. Repeatable."),
    ] = None,
    pool: Annotated[
        list[int] | None,
        typer.Option("--pool", min=0, max=10_000, help="Detector: cell size, pixels. Repeatable."),
    ] = None,
    width: Annotated[
        list[float] | None,
        typer.Option(
            "--width", min=0, max=1000, help="Detector: width multiplier of the layers. Repeatable."
        ),
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Detector: run the full grid of values.")
    ] = False,
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes",
            min=0,
            max=100_000,
            help="Detector: start no training after this many minutes; 0: only write the page.",
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Detector: only print the pending runs and their duration."),
    ] = False,
    campaign: CampaignOption = None,
    reviewed: ReviewedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Measure the cost of accuracy: of a simulated scene, or of the detector on a store."""
    if (scene is None) == (detector is None):
        raise InputError(
            "--scene", "", None, "give exactly one of --scene PROTOCOL and --detector STORE"
        )
    of_detector = {
        "--samples": samples,
        "--epochs": epochs,
        "--seeds": seeds,
        "--stride": stride,
        "--length": length,
        "--step": step,
        "--pool": pool,
        "--width": width,
        "--full": full,
        "--minutes": minutes,
        "--dry-run": dry_run,
        "--campaign": campaign,
        "--reviewed": reviewed,
    }
    of_scene = {"--rig": rig, "--sensitivity": sensitivity, "--dask": dask}
    if scene is not None:
        _refuse(of_detector, "--detector")
        _scene(
            scene, rig or Path("mock"), out or SCENE_OUT, trials or 4, sensitivity, dask, as_json
        )
        return
    _refuse(of_scene, "--scene")
    assert detector is not None
    size = {
        "samples": samples,
        "epochs": epochs,
        "trials": trials,
        "seeds": seeds,
        "stride_ms": stride,
    }
    _detector(
        detector,
        out,
        size,
        _axes(length, step, pool, width),
        campaign,
        full=full,
        reviewed=reviewed,
        minutes=minutes,
        dry_run=dry_run,
        as_json=as_json,
    )


def _axes(
    length: list[int] | None,
    step: list[int] | None,
    pool: list[int] | None,
    width: list[float] | None,
) -> Axes:
    """Return the values of each factor; those that were not given keep their defaults."""
    from sliplab.plugins.studies.detector.grid import Axes

    default = Axes()
    return Axes(
        tuple(sorted(set(length or default.length_ms))),
        tuple(sorted(set(step or default.step_ms))),
        tuple(sorted(set(pool or default.pool_px))),
        tuple(sorted(set(width or default.width))),
    )


def _refuse(options: Mapping[str, object], other: str) -> None:
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
    from sliplab.plugins.studies.scene.page import choice_pairs, short_table
    from sliplab.plugins.studies.scene.run import PAGE, tradeoff_scene

    result = tradeoff_scene(scene, rig, out, trials, sensitivity, dask=dask)
    if as_json:
        console.print_json(result)
        return
    title = f"Cost and error of the scene of {result['protocol']} (simulated)"
    console.print_table(title, *short_table(result))
    console.print_pairs("Required level of physics", choice_pairs(result))
    console.show(f"Page (simulated): {(out / PAGE).resolve()}")


def _detector(
    place: str,
    out: Path | None,
    size: Mapping[str, int | None],
    axes: Axes,
    campaign: list[str] | None,
    *,
    full: bool,
    reviewed: bool,
    minutes: float | None,
    dry_run: bool,
    as_json: bool,
) -> None:
    """Run the detector's search; a size that is None keeps its default."""
    folder = located(place)
    store, campaigns = opened_campaigns(folder, campaign)
    from sliplab.plugins.studies.detector.page import short_table
    from sliplab.plugins.studies.detector.run import PAGE, tradeoff_detector
    from sliplab.plugins.studies.detector.search import SearchSize

    sizes = {name: value for name, value in size.items() if value is not None}
    target = folder / "report" if out is None else out
    result = tradeoff_detector(
        store,
        campaigns,
        target,
        SearchSize(**sizes),
        axes,
        full,
        reviewed,
        minutes,
        dry_run,
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
        f"The fastest detectors by false early trials{simulated}", *short_table(result)
    )
    console.show("Network: window ms/step ms/cell px/width; rule: windows, spikes.")
    console.show(f"Page{simulated}: {(target / PAGE).resolve()}")


@app.command(epilog="Example: sliplab generalise my-study")
def generalise(
    folder: StoreArgument,
    factor: Annotated[
        list[str] | None, typer.Option("--factor", help="Only this factor. Repeatable.")
    ] = None,
    level: Annotated[
        list[str] | None,
        typer.Option("--level", help="Leave this level out, such as '0 deg'. Repeatable."),
    ] = None,
    every: Annotated[
        bool,
        typer.Option("--all", help="Leave out every level in turn; default: each factor's lowest."),
    ] = False,
    skins: Annotated[
        int | None,
        typer.Option("--skins", min=0, max=1000, help="Number of other simulated skins (5)."),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1_000_000, help="Trials per other skin.")
    ] = 36,
    epochs: Annotated[
        int | None,
        typer.Option(
            "--epochs", min=1, max=10_000, help="Epochs per training; default: the protocol's."
        ),
    ] = None,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Test the network on levels left out of training and on other simulated skins."""
    store, campaigns = opened_campaigns(folder, campaign)
    from sliplab.plugins.studies.generalise.results import COLUMNS, row_cells
    from sliplab.plugins.studies.generalise.run import measure_generalisation

    result = measure_generalisation(
        store, campaigns, factor or (), level or (), every, skins, trials, epochs
    )
    if as_json:
        console.print_json(result.to_json())
        return
    simulated = ", simulated" if result.simulated else ""
    rows = [row_cells(name, row) for name, row in result.results.items()]
    console.print_table(f"generalise{simulated}", COLUMNS, rows)
    console.say(f"stored in {result.file}; the next report shows it")


@app.command(epilog="Example: sliplab guesses my-study")
def guesses(
    folder: StoreArgument,
    guess: Annotated[
        list[str] | None,
        typer.Option("--guess", help="Only this assumed parameter of the scene. Repeatable."),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=2, max=1_000_000, help="Test trials per campaign.")
    ] = 20,
    campaign: CampaignOption = None,
    as_json: JsonOption = False,
) -> None:
    """Evaluate some test trials again with each assumed scene parameter 20 % lower and higher."""
    store, campaigns = opened_campaigns(folder, campaign)
    from sliplab.plugins.studies.guesses.results import FIGURES, UNITS, figure_cells
    from sliplab.plugins.studies.guesses.run import GUESSES, measure_guesses

    result = measure_guesses(store, campaigns, tuple(guess or GUESSES), trials)
    if as_json:
        console.print_json(result.to_json())
        return
    columns = [f"{FIGURES[name]} ({UNITS[name]})" for name in FIGURES]
    rows = [
        [name.removeprefix("scene.").removeprefix("event_camera."), *figure_cells(found)]
        for name, found in result.settings.items()
    ]
    console.print_table("guesses, simulated", ["setting", *columns], rows)
    console.say(f"stored in {result.file}; the next report shows them")
