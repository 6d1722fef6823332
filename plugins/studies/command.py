"""`sliplab tradeoff` and `generalise`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.flows.cli.common import (
    CampaignOption,
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

app = typer.Typer()


@app.command(epilog="Example: sliplab tradeoff my-study")
def tradeoff(
    folder: Annotated[
        Path | None, typer.Argument(metavar="STORE", help="A labelled store.", show_default=False)
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="Output folder; default: STORE/report.")
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=1_000_000, help="Validation and test trials each.")
    ] = 60,
    samples: Annotated[
        int, typer.Option("--samples", min=3, max=1_000_000_000, help="Windows per training.")
    ] = 12_000,
    epochs: Annotated[
        int, typer.Option("--epochs", min=1, max=10_000, help="Epochs per training.")
    ] = 4,
    seeds: Annotated[int, typer.Option("--seeds", min=1, max=1000, help="Seeds per setting.")] = 3,
    stride: Annotated[
        int, typer.Option("--stride", min=1, max=1000, help="The smallest stride, ms.")
    ] = 10,
    length: Annotated[
        list[int] | None,
        typer.Option("--length", min=0, max=10_000, help="Window length, ms. Repeatable."),
    ] = None,
    step: Annotated[
        list[int] | None,
        typer.Option("--step", min=0, max=10_000, help="Time step, ms. Repeatable."),
    ] = None,
    pool: Annotated[
        list[int] | None,
        typer.Option("--pool", min=0, max=10_000, help="Cell size, pixels. Repeatable."),
    ] = None,
    width: Annotated[
        list[float] | None,
        typer.Option(
            "--width", min=0, max=1000, help="Width multiplier of the layers. Repeatable."
        ),
    ] = None,
    full: Annotated[bool, typer.Option("--full", help="Run the full grid of values.")] = False,
    minutes: Annotated[
        float | None,
        typer.Option(
            "--minutes",
            min=0,
            max=100_000,
            help="Start no training after this many minutes; 0: only write the page.",
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print the pending runs and their duration.")
    ] = False,
    campaign: CampaignOption = None,
    reviewed: ReviewedOption = False,
    detector: Annotated[
        Path | None, typer.Option("--detector", hidden=True, help="Former name of STORE.")
    ] = None,
    scene: Annotated[Path | None, typer.Option("--scene", hidden=True)] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure what accuracy costs: a detector's settings varied on the trials of a store."""
    if scene is not None:
        raise InputError(
            "--scene",
            "",
            str(scene),
            f"has moved: python -m benchmarks.scene_tradeoff {scene}, in a checkout of SlipLab",
        )
    if detector is not None:
        console.say(f"--detector is an old name; write: sliplab tradeoff {detector}")
    place = folder or detector
    if place is None:
        raise InputError("STORE", "", None, "is needed: a labelled store")
    store, campaigns = opened_campaigns(located(str(place)), campaign)
    from sliplab.plugins.studies.detector.page import short_table
    from sliplab.plugins.studies.detector.run import PAGE, tradeoff_detector
    from sliplab.plugins.studies.detector.search import SearchSize

    target = store.folder / "report" if out is None else out
    result = tradeoff_detector(
        store,
        campaigns,
        target,
        SearchSize(samples, epochs, trials, seeds, stride),
        _axes(length, step, pool, width),
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
        console.print_pairs(f"tradeoff {place}{simulated}", shown)
        return
    console.print_table(
        f"The fastest detectors by false early trials{simulated}", *short_table(result)
    )
    console.show("Network: window ms/step ms/cell px/width; rule: windows, spikes.")
    console.show(f"Page{simulated}: {(target / PAGE).resolve()}")


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


@app.command(hidden=True)
def guesses(
    folder: Annotated[Path, typer.Argument(metavar="STORE")], as_json: JsonOption = False
) -> None:
    """Moved to the benchmarks."""
    raise InputError(
        "COMMAND",
        "",
        "guesses",
        f"has moved: python -m benchmarks.guesses {folder}, in a checkout of SlipLab",
    )
