"""Latency and lead in the report: kinematic slides, falling plates, and disturbed ones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.metrics.intervals import difference, exact_interval, interval
from sliplab.analysis.report import clocks
from sliplab.analysis.report.figures.intervals import Panel, by_condition
from sliplab.analysis.report.figures.style import BLUE, FIRST_SLIP, GREEN, ORANGE, RED
from sliplab.analysis.report.outcomes import (
    CAUSE,
    OUTCOMES,
    TIMES,
    WORDS,
    Conditions,
    Rule,
    least_ms,
    times,
)
from sliplab.analysis.report.page import Content, Figure, Table, number, percent, with_interval
from sliplab.storage.schema.evaluation import TrialScore
from sliplab.storage.schema.summary import (
    Accounts,
    Experiment,
    OneCameraSummary,
    Summary,
    TrialOutcome,
)

AXES = {
    "duration_ms": ("incipient slip lasts (ms)", GREEN, ""),
    "latency_incipient_ms": ("incipient latency (ms)", ORANGE, "labelled onset"),
    "latency_gross_ms": ("gross latency (ms)", RED, "labelled onset"),
    "lead_ms": ("lead before gross slip (ms)", BLUE, "gross slip"),
}
NAMES = {
    "duration_ms": "length of incipient slip",
    "latency_incipient_ms": "incipient latency",
    "latency_gross_ms": "gross latency",
    "lead_ms": "lead",
}
EXPERIMENTS = {
    "kinematic": "Slides",
    "gravity": "Plates that slip by their own weight",
    "disturbance": "Plates that slip while the sensor is pulled sideways",
}
STATISTICS = {
    "n": "n",
    "mean": "mean (95 %)",
    "median": "median (95 %)",
    "p95": "95th percentile (95 %)",
    "std": "std",
    "min": "min",
    "max": "max",
    "missed": "missed",
    "late": "late",
    "false_early": "false early",
}
_SHORT = {"missed": "missed", "late": "late", "false_early": "early", "without_onsets": "no onset"}


@dataclass(frozen=True)
class FactorTrend:
    """Change of a time's mean from a factor's first to its last level.

    Its interval is one of those that hold all changes of a section at once.
    """

    first: str
    last: str
    change: float
    low: float
    high: float


@dataclass(frozen=True)
class LatencySection(Content):
    """Detections of one experiment's test trials.

    Attributes:
        title: of the section.
        by: the factors by which the figures have rows.
        smallest: lead, as text with what it is among.
        late: onset, number and range in ms of detections after their event.
        choices: how smoothing and margin were chosen.
        trends: by time, as text.
        clock_note: under figures; nothing where it cannot be seen in them.
    """

    template: ClassVar[str] = "latency.html"
    experiment: str
    numbers: Experiment
    smallest: str
    by: Sequence[str]
    late: Sequence[tuple[str, int, float, float]]
    choices: Sequence[str]
    trends: Mapping[str, Sequence[FactorTrend]]
    latency_note: str
    clock_note: str
    figures: Sequence[Figure]
    statistics: Table
    accounts: Table
    levels: Sequence[Table]
    seeds: Table | None

    @property
    def lead_mean(self) -> str:
        """Mean lead with its interval."""
        return with_interval(self.numbers.lead_ms.mean, self.numbers.intervals.lead_ms.mean, 0)

    @property
    def others(self) -> list[tuple[int, str]]:
        """Trials that were not detected first: number and cause."""
        counts = [(self.numbers.accounted.of(name), WORDS[name]) for name in OUTCOMES[1:]]
        return [(count, words) for count, words in counts if count]


def latency_section(
    experiment: str,
    campaigns: Sequence[Collected],
    rows: Sequence[TrialScore],
    summary: Summary | OneCameraSummary,
) -> LatencySection | None:
    """Show an experiment's detections by condition; None without trials, unless kinematic.

    Args:
        rows: of the evaluation.
    """
    numbers: Experiment = getattr(summary, experiment)
    kinematic = experiment == "kinematic"
    if not kinematic and not numbers.trials:
        return None
    found = Conditions(campaigns, rows, experiment)
    by = found.varied() if kinematic else found.varied()[:2]
    late = []
    for kind in ("incipient", "gross"):
        mine = [row for row in summary.trials if row.experiment == experiment]
        if there := times(mine, f"late_{kind}_ms"):
            late.append((kind, len(there), min(there), max(there)))
    rules = [
        summary.detection[item.name].choose
        for item in campaigns
        if item.experiment == experiment and item.name in summary.detection
    ]
    judged_by = list(summary.detection.values())
    shown = TIMES[1:3] if kinematic else TIMES
    kinds = ("incipient", "gross") if kinematic else ("incipient", "gross", "lead")
    return LatencySection(
        experiment,
        numbers,
        smallest_lead(summary, experiment),
        by,
        late,
        sorted({choice_note(rule) for rule in rules} - {""}),
        _trends(found, shown),
        clocks.latency_note(summary.sync, summary.labels),
        clocks.figure_note(summary.sync),
        _figures(experiment, found, by, judged_by, numbers.first_slip_ms, summary.simulated),
        _statistics(numbers, kinds),
        _accounts(experiment, numbers.accounted),
        [] if kinematic else [_by_level(found, factor, judged_by) for factor in found.varied()],
        _by_seed(numbers, kinds),
    )


def smallest_lead(summary: Summary | OneCameraSummary, experiment: str) -> str:
    """Return the smallest lead as text, with the next one, and that of other networks and seeds.

    It is one trial's, and the figure that changes most with another network or other trials.
    """
    mine = [row for row in summary.trials if row.experiment == experiment]
    leads = sorted(times(mine, "lead_ms"))
    if not leads:
        return number(None)
    text = f"{leads[0]:.0f} ms, in one trial of {len(leads)}"
    if len(leads) > 1:
        text += f" (the next {leads[1]:.0f} ms, half above {median(leads):.0f} ms)"
    numbers: Experiment = getattr(summary, experiment)
    others = [(f"seed {it.seed}", it.lead_ms.min) for it in numbers.by_seed if not it.chosen]
    if isinstance(summary, Summary):
        others += [
            (
                f"the {of.preset} preset" if of.preset else of.title,
                getattr(of, experiment).lead_ms.min,
            )
            for of in summary.networks.values()
        ]
    known = [f"{name} {least:.0f} ms" for name, least in others if least is not None]
    return "; ".join([text, *known])


def choice_note(chosen_by: str) -> str:
    """Return how smoothing and margin were chosen, as text; nothing where the protocol says it."""
    if chosen_by == "validation":
        return "Smoothing and margin were chosen by validation trials."
    if chosen_by == "test":
        return (
            "Smoothing and margin were chosen by the kinematic test trials themselves, as in the "
            "paper: what is measured on them flatters."
        )
    return ""


def _figures(
    experiment: str,
    found: Conditions,
    by: Sequence[str],
    rules: Sequence[Rule],
    first_slip_ms: float | None,
    simulated: bool,
) -> list[Figure]:
    """Draw the experiment's times by condition."""
    draw = partial(draw_times, rules=rules, simulated=simulated, first_slip_ms=first_slip_ms)
    if experiment == "kinematic":
        groups, breaks = {"all test trials": found.trials}, []
        for factor in by:
            breaks.append(len(groups))
            groups |= {
                f"{factor} {text}": found.at(**{factor: text}) for text in found.factors[factor]
            }
        return [draw(groups, TIMES[1:3], breaks, "latency-kinematic")]
    groups, breaks = found.cells(by), found.breaks(by)
    if experiment == "disturbance":
        return [draw(groups, TIMES[1:], breaks, "disturbance")]
    return [
        draw(groups, TIMES[:2], breaks, "gravity-incipient"),
        draw(groups, TIMES[2:], breaks, "gravity-gross"),
    ]


def draw_times(
    groups: Mapping[str, Sequence[TrialOutcome]],
    shown: Sequence[str],
    breaks: Sequence[int],
    name: str,
    rules: Sequence[Rule],
    simulated: bool,
    first_slip_ms: float | None = None,
) -> Figure:
    """Draw times of trials, a panel each.

    Args:
        groups: trials by the name of their row.
        shown: which of `TIMES`.
        breaks: rows that begin a new group.
        name: of the figure.
        rules: as of `least_ms`.
        first_slip_ms: as of an `Experiment`.
    """
    panels = []
    for time in shown:
        label, colour, zero = AXES[time]
        values = {row: times(found, time) for row, found in groups.items()}
        notes = {row: _lacking(found, time) for row, found in groups.items()}
        limit = None
        if time == "latency_incipient_ms" and first_slip_ms is not None:
            limit = first_slip_ms, FIRST_SLIP
        least = least_ms(time, rules)
        panels.append(Panel(label, values, colour, zero, notes, least, limit))
    svg = by_condition(list(groups), panels, simulated=simulated, breaks=breaks)
    trials = [(row, trial) for row, found in groups.items() for trial in found]
    data: dict[str, list[object]] = {
        "row": [row for row, _ in trials],
        "trial": [trial.trial for _, trial in trials],
        **{AXES[time][0]: [getattr(trial, time) for _, trial in trials] for time in shown},
    }
    return Figure(svg, name=name, data=data)


def _lacking(rows: Sequence[TrialOutcome], time: str) -> str:
    """Return how many trials have no value, and why, in short."""
    if not rows:
        return "no trial"
    without = [row for row in rows if getattr(row, time) is None]
    if time not in CAUSE:
        return f"{len(without)} without onset" if without else ""
    causes = [getattr(row, CAUSE[time]) for row in without]
    return ", ".join(f"{causes.count(k)} {word}" for k, word in _SHORT.items() if k in causes)


def _trends(found: Conditions, names: Sequence[str]) -> dict[str, list[FactorTrend]]:
    """Compare the means at each factor's first and last level, by time."""
    pairs = []
    for name, factor in itertools.product(names, found.varied()):
        levels = found.factors[factor]
        if len(levels) < 2 or levels[0].endswith(" deg"):  # an angle has no first and last
            continue
        first, last = (times(found.at(**{factor: levels[k]}), name) for k in (0, -1))
        if difference(last, first) is not None:
            pairs.append((name, levels, first, last))
    trends: dict[str, list[FactorTrend]] = {}
    for name, levels, first, last in pairs:
        low, high = difference(last, first, comparisons=len(pairs)) or (math.nan, math.nan)
        change = sum(last) / len(last) - sum(first) / len(first)
        trend = FactorTrend(levels[0], levels[-1], change, low, high)
        trends.setdefault(NAMES[name], []).append(trend)
    return trends


def _by_level(found: Conditions, factor: str, rules: Sequence[Rule]) -> Table:
    rows, least = [], [least_ms(name, rules) for name in TIMES]
    for text in found.factors[factor]:
        there = found.at(**{factor: text})
        known = [times(there, name) for name in TIMES]
        means = [
            with_interval(sum(of) / len(of) if of else None, interval(of, least=end), 0)
            for end, of in zip(least, known, strict=True)
        ]
        rows.append([text, str(len(there)), *means])
    columns = [factor, "trials", *(f"{NAMES[name]} (ms)" for name in TIMES)]
    return Table(columns, rows, "Means with 95 % intervals over trials.")


def _statistics(numbers: Experiment, kinds: Sequence[str]) -> Table:
    rows = []
    for kind in kinds:
        if kind == "lead":
            name, found, spans = "lead", numbers.lead_ms, numbers.intervals.lead_ms
        else:
            name, found = f"{kind} latency", getattr(numbers.latency_ms, kind)
            spans = numbers.intervals.of(f"latency_{kind}_ms")
        cells = [
            with_interval(getattr(found, key), getattr(spans, key))
            if key in ("mean", "median", "p95")
            else number(getattr(found, key))
            for key in STATISTICS
        ]
        rows.append([name, *cells])
    return Table(("", *STATISTICS.values()), rows)


def _by_seed(numbers: Experiment, kinds: Sequence[str]) -> Table | None:
    """Show medians of every trained network; None of one alone."""
    if not numbers.by_seed:
        return None
    rows = []
    for found in numbers.by_seed:
        of = {**vars(found.latency_ms), "lead": found.lead_ms}
        medians = [number(of[kind].median) for kind in kinds]
        incipient = found.latency_ms.incipient
        counts = (incipient.missed, incipient.late, incipient.false_early)
        shown = f"{found.seed}, shown above" if found.chosen else str(found.seed)
        rows.append([shown, *medians, *map(str, counts)])
    names = ["lead" if kind == "lead" else f"{kind} latency" for kind in kinds]
    columns = ("seed", *(f"median {name} (ms)" for name in names), "missed", "late", "false early")
    return Table(columns, rows)


def _accounts(experiment: str, accounts: Accounts) -> Table:
    cells = []
    for name in OUTCOMES:
        count = accounts.of(name)
        low, high = exact_interval(count, accounts.planned)
        shares = f" ({100 * low:.0f} to {percent(high, 0)})" if accounts.planned else ""
        cells.append(f"{count}{shares}")
    columns = ("trials", "planned for the test", *(WORDS[name] for name in OUTCOMES))
    return Table(columns, [[experiment, str(accounts.planned), *cells]])
