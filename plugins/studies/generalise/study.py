"""`sliplab generalise`: accuracy on levels left out of training and on other simulated skins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.flows.cli.common import CampaignOption, PlaceArgument, opened_campaigns
from sliplab.flows.steps import located
from sliplab.plugins.studies.generalise.document import (
    GeneralisationResults,
    NotTrained,
    UnseenScores,
)

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

Results = Mapping[str, UnseenScores | NotTrained]
"""By factor and level, or by skin."""


def measure(
    folder: PlaceArgument,
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
) -> Finding[GeneralisationResults]:
    """Test the network on levels left out of training and on other simulated skins."""
    store, campaigns = opened_campaigns(located(folder), campaign)
    from sliplab.plugins.studies.generalise.run import measure_generalisation

    return measure_generalisation(
        store, campaigns, factor or (), level or (), every, skins, trials, epochs
    )


def shown(found: GeneralisationResults, requested: Results, file: Path) -> Iterator[Table | str]:
    """Yield the results that were requested, and the file that has them all."""
    simulated = ", simulated" if found.simulated else ""
    yield replace(_table(requested), caption=f"generalise{simulated}")
    yield f"stored in {file}; the next report shows it"


def view(found: GeneralisationResults, requested: Results, file: Path) -> dict[str, object]:
    """Return what the page shows: all results of the store."""
    from sliplab.plugins.studies.generalise.section import unseen_figure

    figure = unseen_figure(found, simulated=found.simulated)
    return {
        "figure_of": figure and replace(figure, name=""),
        "results": _table(found.skins_last),
    }


def _table(results: Results) -> Table:
    from sliplab.analysis.report.page import Table
    from sliplab.plugins.studies.generalise.results import COLUMNS, row_cells

    return Table(COLUMNS, [row_cells(name, row) for name, row in results.items()])


STUDY = Study(
    name="generalise",
    title="Levels left out and other skins, by SlipLab",
    measure=measure,
    result=GeneralisationResults,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab generalise my-study",
)
