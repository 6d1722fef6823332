"""`sliplab reflex`: drops that reflexes prevent on a simulated rig."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sliplab.analysis.study import Finding, Study
from sliplab.plugins.reflex.document import ReflexRow, ReflexStudy, ReflexTrial, title_of

if TYPE_CHECKING:
    from sliplab.analysis.report.page import Table

COLUMNS = (
    "reflex",
    "trials",
    "dropped",
    "drops prevented (95 %)",
    "too early",
    "missed",
    "fallen (mm), median",
    "95 %",
    "extra force (N), median",
    "largest",
)
REACTION = ("reflex", "total (ms)", "window", "sensor", "network", "command", "actuator", "p99")
MOST_SHOWN = 7
"""Courses in the figure of one trial."""


def measure(
    model: Annotated[
        Path,
        typer.Argument(
            metavar="MODEL|STORE", help="A trained network, or a store with all its detectors."
        ),
    ],
    rig: Annotated[
        Path, typer.Option("--rig", help="A simulated rig: a rig file (YAML), or a name.")
    ] = Path("mock-gripper"),
    protocol: Annotated[
        Path, typer.Option("--protocol", help="Gravity trials (YAML); default: reflex.")
    ] = Path("reflex"),
    reflexes: Annotated[
        list[str] | None,
        typer.Option(
            "--reflex",
            help="stop, press:MM or grip:MM. Repeatable. Default: stop, press:0.4, and grip:0.4 "
            "on a rig with a gripper.",
        ),
    ] = None,
    detectors: Annotated[
        list[str] | None,
        typer.Option(
            "--detector",
            help="Of a store: network or paper (with the rule), or another; or any of `sliplab "
            "bench`. Repeatable. Default: all of the store.",
        ),
    ] = None,
    trials: Annotated[
        int, typer.Option("--trials", min=1, max=10_000, help="Trials of each condition.")
    ] = 1,
    out: Annotated[Path, typer.Option("--out", help="Folder for the page and its numbers.")] = Path(
        "sliplab-reflex"
    ),
) -> Finding[ReflexStudy]:
    """Run trials with and without reflexes: drops prevented, way fallen, force, reaction time."""
    if model.is_dir():
        from sliplab.flows.steps import prepare_store
        from sliplab.storage.remote.mirror import open_store

        open_store(model)
        prepare_store(model)  # before anything imports Prefect
    from sliplab.plugins.reflex.flow import measure_reflexes, request

    asked = request(model, rig, out, protocol, reflexes or (), trials, detectors or ())
    return Finding(measure_reflexes(asked), out)


def shown(study: ReflexStudy) -> Iterator[Table]:
    """Yield the table of reflexes."""
    from sliplab.analysis.report.page import Table

    yield Table(COLUMNS, [_cells(row) for row in study.rows], "reflexes, simulated")


def view(study: ReflexStudy) -> dict[str, object]:
    """Return what the page shows."""
    from sliplab.analysis.report.page import Figure, Table
    from sliplab.plugins.reflex import plot

    simulated, rows, trials = study.simulated, study.rows, list(study.trials.values())
    reacting = [row for row in rows if row.reaction is not None]
    courses = _example(study)
    return {
        "count": len({it.trial for it in trials}),
        "outcomes": Figure(plot.outcomes(rows, trials, simulated=simulated)),
        "table_of_outcomes": Table(COLUMNS, [_cells(row) for row in rows]),
        "fallen": Figure(plot.fallen(rows, trials, simulated=simulated)),
        "reactions": Figure(plot.reactions(rows, simulated=simulated)) if reacting else None,
        "table_of_reactions": Table(REACTION, [_reaction_cells(row) for row in reacting]),
        "courses": Figure(plot.courses(courses, simulated=simulated)),
        "example": courses[0].trial,
    }


def _cells(row: ReflexRow) -> list[str]:
    """Return a row's outcome below `COLUMNS`."""
    from sliplab.analysis.report.page import number

    return [
        title_of(row),
        str(row.trials),
        str(row.dropped),
        _prevented(row),
        str(row.early),
        str(row.missed) if row.reflex else "–",
        number(row.fallen_mm, 2),
        number(row.fallen_p95_mm, 2),
        number(row.extra_n, 2),
        number(row.most_extra_n, 2),
    ]


def _prevented(row: ReflexRow) -> str:
    from sliplab.analysis.report.page import percent

    if row.reflex is None or row.low is None or row.high is None:
        return "–"
    span = f"{percent(row.low, 0).removesuffix(' %')} to {percent(row.high, 0)}"
    return f"{row.prevented} of {row.would_drop} ({span})"


def _reaction_cells(row: ReflexRow) -> list[str]:
    from sliplab.analysis.report.page import number

    times = (row.total_ms, *(getattr(row.reaction, name) for name in REACTION[2:-1]))
    return [title_of(row), *(number(ms, 1) for ms in times), number(row.computer_p99_ms, 2)]


def _example(study: ReflexStudy) -> list[ReflexTrial]:
    """Return one trial without a reflex, and with each reflex and detector; at most `MOST_SHOWN`.

    It is the middle one of those that drop without a reflex. Where there are more detectors, each
    reflex is shown with the one that prevents the most drops, and the one that prevents the fewest.
    """
    trials = list(study.trials.values())
    drops = [it.trial for it in trials if it.reflex is None and it.dropped]
    chosen = drops[len(drops) // 2] if drops else trials[0].trial
    found = [it for it in trials if it.trial == chosen]
    if len(found) > MOST_SHOWN:
        ends: set[tuple[str | None, str | None]] = {(None, None)}
        for reflex in {row.reflex for row in study.rows if row.reflex is not None}:
            rows = [row for row in study.rows if row.reflex == reflex]
            for choose in (max, min):
                ends.add((choose(rows, key=lambda row: row.prevented).detector, reflex))
        found = [it for it in found if (it.detector, it.reflex) in ends]
    return sorted(found, key=lambda it: (it.reflex is not None, it.reflex or "", it.detector or ""))


STUDY = Study(
    name="reflex",
    title="Drops that reflexes prevent, by SlipLab",
    measure=measure,
    result=ReflexStudy,
    page=Path(__file__).with_name("page.html"),
    view=view,
    shown=shown,
    example="sliplab reflex my-study --rig mock_gripper",
)
