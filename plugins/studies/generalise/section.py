"""Levels and skins that the network never saw, in the report."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from sliplab.analysis.report.figures.intervals import ShareInterval, shares
from sliplab.analysis.report.page import Content, Figure, Table, percent
from sliplab.analysis.report.plugin_sections import ReportData, ReportSection
from sliplab.analysis.report.programs import CommandResult
from sliplab.analysis.report.seeds import seed_words
from sliplab.analysis.report.windows import share_data
from sliplab.plugins.studies.generalise.document import GeneralisationResults, NotTrained
from sliplab.storage.streams import Json

RESULT = CommandResult("derived/generalisation/results.json", "sliplab generalise {store}")


@dataclass(frozen=True)
class GeneralisationSection(Content):
    """The network on skins and levels that it never saw, or how to measure it."""

    template: ClassVar[Path] = Path(__file__).with_name("section.html")
    command: str
    figure: Figure | None = None
    table: Table | None = None
    seeds: str = ""

    @property
    def unmeasured(self) -> bool:
        """True where it was not measured."""
        return self.table is None


def skin_section(
    found: Json | None, command: str, strict: float | None, seeds: str = "", *, simulated: bool
) -> GeneralisationSection:
    """Show the results of `sliplab generalise`.

    Args:
        strict: accuracy of the network on its own skin. seeds: that were trained there, in words.

    Raises:
        StoreError: they are of another shape.
    """
    if found is None:
        return GeneralisationSection(command)
    results = RESULT.parse(GeneralisationResults, found)
    columns = ("left out, or skin", "trials", "windows", "right", "95 %", "levels that were seen")
    rows = []
    for name, row in results.skins_last.items():
        if isinstance(row, NotTrained):
            rows.append([name, row.why, "", "", "", ""])
            continue
        span = "–" if row.low is None else f"{percent(row.low)} to {percent(row.high)}"
        rows.append(
            [name, str(row.trials), str(row.n), percent(row.share), span, percent(row.seen)]
        )
    figure = unseen_figure(results, strict, simulated=simulated)
    return GeneralisationSection(command, figure, Table(columns, rows), seeds)


def unseen_figure(
    results: GeneralisationResults, strict: float | None = None, *, simulated: bool
) -> Figure | None:
    """Draw accuracies on levels left out and on other skins; None where nothing was trained.

    Args:
        strict: accuracy of the network on its own skin.
    """
    groups: dict[str, list[ShareInterval]] = {}
    for name, row in results.skins_last.items():
        if not isinstance(row, NotTrained):
            group = "other skins" if name.startswith("skin ") else f"without a {name.split()[0]}"
            item = ShareInterval(name, row.share, row.low, row.high)
            groups.setdefault(group, []).append(item)
    if not groups:
        return None
    drawn = [item for of in groups.values() for item in of]
    line = None if strict is None else (strict, "this network, its own skin")
    svg = shares(groups, "windows classified correctly (%)", simulated=simulated, line=line)
    return Figure(svg, name="skins", data=share_data(drawn))


def _make(data: ReportData) -> GeneralisationSection | None:
    if data.collected is None:
        return None
    kinematic = data.collected.kinematic
    return skin_section(
        RESULT.read(data.store),
        RESULT.command(data.store),
        kinematic.accuracy.strict,
        seed_words(kinematic.seeds),
        simulated=data.simulated,
    )


SECTION = ReportSection(_make, RESULT.key, last=True)
"""Skins and levels in the report."""
