"""`sliplab tradeoff`: speed of a detector against its errors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, opened_campaigns
from sliplab.flows.cli.steps import ReviewedOption
from sliplab.flows.running import console
from sliplab.flows.steps import located
from sliplab.plugins.studies.detector.document import DetectorTradeoff
from sliplab.plugins.studies.detector.grid import Axes
from sliplab.protocols.errors import InputError

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

PLAN = ("runs", "kept", "pending", "estimated_s")


def measure(
    folder: Annotated[
        str | None, typer.Argument(metavar="STORE", help="A labelled store.", show_default=False)
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
        str | None, typer.Option("--detector", hidden=True, help="Former name of STORE.")
    ] = None,
    scene: Annotated[Path | None, typer.Option("--scene", hidden=True)] = None,
) -> Finding[DetectorTradeoff]:
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
    store, campaigns = opened_campaigns(located(place), campaign)
    from sliplab.plugins.studies.detector.run import tradeoff_detector
    from sliplab.plugins.studies.detector.search import SearchSize

    default = Axes()
    axes = Axes(
        tuple(sorted(set(length or default.length_ms))),
        tuple(sorted(set(step or default.step_ms))),
        tuple(sorted(set(pool or default.pool_px))),
        tuple(sorted(set(width or default.width))),
    )
    return tradeoff_detector(
        store,
        campaigns,
        store.folder / "report" if out is None else out,
        SearchSize(samples, epochs, trials, seeds, stride),
        axes,
        full,
        reviewed,
        minutes,
        dry_run,
    )


def shown(result: DetectorTradeoff) -> Iterator[Table | str]:
    """Yield the short list; of a plan its trainings and their time."""
    from sliplab.analysis.report.page import Table, number
    from sliplab.plugins.studies.detector.page import short_table

    if result.estimated_s is not None:
        simulated = " (simulated)" if result.simulated else ""
        counts = [str(getattr(result, name)) for name in PLAN[:-1]]
        yield Table(PLAN, [[*counts, number(result.estimated_s, 0)]], f"tradeoff{simulated}")
        return
    yield short_table(result)
    yield "Network: window ms/step ms/cell px/width; rule: windows, spikes."


def view(result: DetectorTradeoff) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.plugins.studies.detector import page

    return page.view(result)


STUDY = Study(
    name="tradeoff",
    title="Speed of detectors against their errors, by SlipLab",
    measure=measure,
    result=DetectorTradeoff,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab tradeoff my-study",
)
