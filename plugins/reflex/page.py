"""The page of a study of reflexes."""

from __future__ import annotations

from pathlib import Path

from sliplab.analysis.report.page import Figure, Table, number, percent, render_page
from sliplab.plugins.reflex import plot as figures
from sliplab.plugins.reflex.document import ReflexRow, ReflexStudy, ReflexTrial

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
MOST_SHOWN = 7
"""Courses in the figure of one trial."""
REACTION = ("reflex", "total (ms)", "window", "sensor", "network", "command", "actuator", "p99")


def cells(row: ReflexRow) -> list[str]:
    """Return a row's outcome below `COLUMNS`."""
    return [
        figures.title_of(row),
        str(row.trials),
        str(row.dropped),
        prevented(row),
        str(row.early),
        str(row.missed) if row.reflex else "–",
        number(row.fallen_mm, 2),
        number(row.fallen_p95_mm, 2),
        number(row.extra_n, 2),
        number(row.most_extra_n, 2),
    ]


def prevented(row: ReflexRow) -> str:
    """Return the drops that were prevented, with the exact interval of their share."""
    if row.reflex is None or row.low is None or row.high is None:
        return "–"
    span = f"{percent(row.low, 0).removesuffix(' %')} to {percent(row.high, 0)}"
    return f"{row.prevented} of {row.would_drop} ({span})"


def reaction_cells(row: ReflexRow) -> list[str]:
    """Return the medians of a row's reaction below `REACTION`."""
    parts = row.reaction
    assert parts is not None
    times = (row.total_ms, *(getattr(parts, name) for name in figures.PART_COLOURS))
    return [figures.title_of(row), *(number(ms, 1) for ms in times), number(row.computer_p99_ms, 2)]


def example(study: ReflexStudy) -> list[ReflexTrial]:
    """Return one trial without a reflex, and with each reflex and detector; at most `MOST_SHOWN`.

    It is the middle one of those that drop without a reflex. Where there are more detectors, each
    reflex is shown with the one that prevents the most drops, and the one that prevents the fewest.
    """
    trials = list(study.trials.values())
    drops = [it.trial for it in trials if it.reflex is None and it.dropped]
    chosen = drops[len(drops) // 2] if drops else trials[0].trial
    shown = [it for it in trials if it.trial == chosen]
    if len(shown) > MOST_SHOWN:
        ends: set[tuple[str | None, str | None]] = {(None, None)}
        for reflex in {row.reflex for row in study.rows if row.reflex is not None}:
            rows = [row for row in study.rows if row.reflex == reflex]
            for choose in (max, min):
                ends.add((choose(rows, key=lambda row: row.prevented).detector, reflex))
        shown = [it for it in shown if (it.detector, it.reflex) in ends]
    return sorted(shown, key=lambda it: (it.reflex is not None, it.reflex or "", it.detector or ""))


def render(study: ReflexStudy) -> str:
    """Return the page as text."""
    simulated, trials = study.simulated, list(study.trials.values())
    reacting = [row for row in study.rows if row.reaction is not None]
    shown = example(study)
    return render_page(
        Path(__file__).with_name("page.html"),
        simulated=simulated,
        study=study,
        count=len({it.trial for it in trials}),
        outcomes=Figure(figures.outcomes(study.rows, trials, simulated=simulated)),
        table_of_outcomes=Table(COLUMNS, [cells(row) for row in study.rows]),
        fallen=Figure(figures.fallen(study.rows, trials, simulated=simulated)),
        reactions=Figure(figures.reactions(study.rows, simulated=simulated)) if reacting else None,
        table_of_reactions=Table(REACTION, [reaction_cells(row) for row in reacting]),
        courses=Figure(figures.courses(shown, simulated=simulated)),
        example=shown[0].trial,
    )
