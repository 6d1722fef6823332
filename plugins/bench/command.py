"""`sliplab bench`: detectors of slip on the open bench."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from sliplab.flows.cli.common import JsonOption
from sliplab.flows.running import console

app = typer.Typer()


@app.command(epilog="Example: sliplab bench --small")
def bench(
    detectors: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="DETECTOR...",
            help="Names of shipped detectors, MODULE:ATTRIBUTE, files that end in .onnx, or "
            "run:COMMAND; default: all that ship.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option("--seed", min=0, max=2**31, help="Draws the test worlds.")
    ] = 1,
    small: Annotated[bool, typer.Option("--small", help="Fewer scenes, for a first look.")] = False,
    folder: Annotated[
        Path, typer.Option("--folder", help="Keeps the results, so that a run resumes.")
    ] = Path("sliplab-bench"),
    workers: Annotated[
        int | None,
        typer.Option("--workers", min=1, max=1024, help="Processes; default: one a core."),
    ] = None,
    leaderboard: Annotated[
        Path | None,
        typer.Option("--leaderboard", help="Also write the table into this page (Markdown)."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Judge detectors on simulated scenes: latency at a false alarm an hour, and its cost."""
    from sliplab.plugins.bench import page
    from sliplab.plugins.bench.run import run_bench

    if leaderboard is not None:
        page.check_page(leaderboard)
    size = "small" if small else "full"
    found = run_bench(detectors or page.SHIPPED, size, seed, folder, workers or os.cpu_count() or 1)
    if leaderboard is not None:
        page.write_leaderboard(leaderboard, found)
    page.write_plot(folder / page.PLOT, found)
    if as_json:
        console.print_json(found.to_json())
        return
    console.print_table(page.title(found), page.COLUMNS, page.rows(found))
    console.show(page.interval_note(found))
    console.show(f"Latency against false alarms (simulated): {(folder / page.PLOT).resolve()}")
