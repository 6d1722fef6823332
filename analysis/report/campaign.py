"""Campaigns in the report: collected trials, their quality over time, and wear of the skin."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import ClassVar

import numpy as np
from scipy.stats import theilslopes

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.quality import hold_rate
from sliplab.analysis.report.figures import campaign as figures
from sliplab.analysis.report.page import Content, Figure, Table, number
from sliplab.protocols import Plan, PlannedTrial
from sliplab.protocols.recorded import RecordedPlan
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.schema.summary import (
    DriftTrend,
    OneCameraSummary,
    QualitySummary,
    ReferenceSummary,
    ReferenceTrial,
    Summary,
)
from sliplab.storage.schema.trial import Gate
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.store import TrialStore

FEWEST = 3
"""Fewest reference trials from which a slope can be estimated."""
WEAR = {
    "hold_events_per_s": ("event rate in the hold", "events in the hold\n(1/s)"),
    "first_slip_ms": ("time to the first slip", "motion to first slip\n(ms)"),
}
"""Compared figures of reference trials: title, and label of the axis."""


@dataclass(frozen=True)
class CollectedSection(Content):
    """Committed trials compared with the plans.

    Attributes:
        source: the stored data of the outside camera, as text.
        grids: trials by the first two factors of each campaign, with its name and theirs.
    """

    template: ClassVar[str] = "collected.html"
    quality: QualitySummary
    source: str
    grids: Sequence[tuple[str, str, str, Figure]]
    table: Table

    def all_figures(self) -> list[Figure]:
        """Return the grids."""
        return [figure for *_, figure in self.grids]


def collected_section(
    campaigns: Sequence[Collected], summary: Summary | OneCameraSummary
) -> CollectedSection:
    """Compare plans and committed trials."""
    grids = [
        grid
        for item in campaigns
        if (
            grid := grid_figure(
                item.name, item.planned, [it for it, _ in item.trials], simulated=summary.simulated
            )
        )
        is not None
    ]
    rows = []
    for item in campaigns:
        known = summary.planned[item.name]
        minutes = (known.seconds / 60, known.seconds_collected / 60)
        megabytes = (known.bytes / 1e6, known.bytes_collected / 1e6)
        rows.append(
            [
                item.name,
                item.experiment,
                str(len(item.planned)),
                str(len(item.trials)),
                *(number(value, 2) for value in minutes),
                *(number(value, 1) for value in megabytes),
            ]
        )
    columns = (
        "campaign",
        "experiment",
        "planned",
        "committed",
        "planned (min)",
        "taken (min)",
        "planned (MB)",
        "taken (MB)",
    )
    frames = summary.labels is not None and any(
        count for name, count in summary.labels.source.items() if name != "events"
    )
    without = "nothing, for this rig has no frame camera"
    if all(item.recorded is not None for item in campaigns):
        without = "nothing: the recordings have no frames"
    retained = source_words(summary) if frames else without
    return CollectedSection(summary.quality, retained, grids, Table(columns, rows))


def tracks_words(simulated: bool) -> str:
    """Return a description of tracks that cannot be mistaken for a video."""
    if simulated:
        return "simulated tracks of the markers (no video was drawn)"
    return "the camera's own tracks of the markers (no video was kept)"


def source_words(summary: Summary | OneCameraSummary) -> str:
    """Return the source of the labels."""
    if summary.labels is None:
        return "nothing yet"
    words = {
        "video": "the video",
        "tracks": tracks_words(summary.simulated),
        "events": "the events of the markers and the arm's motion",
    }
    return " or ".join(words[name] for name, count in summary.labels.source.items() if count)


def grid_figure(
    campaign: str, plan: Plan | RecordedPlan, committed: Sequence[PlannedTrial], *, simulated: bool
) -> tuple[str, str, str, Figure] | None:
    """Draw the trials by the first two factors, with their names; None if there are fewer."""
    names = list(plan.levels)[:2]
    if len(names) < 2:
        return None
    levels = [plan.levels[name] for name in names]
    shape = (len(levels[0]), len(levels[1]))
    counts, planned = np.zeros(shape, np.int64), np.zeros(shape, np.int64)

    def cell(trial: PlannedTrial) -> tuple[int, int]:
        there = plan.describe(trial)
        return levels[0].index(there[names[0]]), levels[1].index(there[names[1]])

    for of, trials in ((planned, plan), (counts, committed)):
        for trial in trials:
            if trial.role == "measured":
                of[cell(trial)] += 1
    axes, shown = [], []
    for name, texts in zip(names, levels, strict=True):
        unit = texts[0].partition(" ")[2] if texts else ""
        axes.append(f"{name} ({unit})" if unit else name)
        shown.append([text.removesuffix(f" {unit}") for text in texts])
    data: dict[str, Sequence[object]] = {
        axes[0]: [level for level in shown[0] for _ in shown[1]],
        axes[1]: [level for _ in shown[0] for level in shown[1]],
        "committed (trials)": counts.ravel().tolist(),
        "planned (trials)": planned.ravel().tolist(),
    }
    svg = figures.collected_grid(
        shown[0], shown[1], counts, planned, axes[0], axes[1], simulated=simulated
    )
    return campaign, names[0], names[1], Figure(svg, name=f"collected-{campaign}", data=data)


@dataclass(frozen=True)
class QualitySection(Content):
    """Event rate, gates and retakes over each campaign, and its reference trials.

    Attributes:
        wear: campaign, figure as text, and its trend.
        over: campaign and its trials one by one; references: the same of its reference trials.
        gates: campaign and the worst trial of each gate; causes: the same of its quarantine.
    """

    template: ClassVar[str] = "quality.html"
    stream: str
    """The stream whose rate is drawn."""
    wear: Sequence[tuple[str, str, DriftTrend]]
    over: Sequence[tuple[str, Figure]]
    references: Sequence[tuple[str, Figure]]
    tables: Sequence[Table]

    def all_figures(self) -> list[Figure]:
        """Return the figures of all campaigns."""
        return [figure for _, figure in (*self.over, *self.references)]


def quality_section(
    campaigns: Sequence[Collected], references: Mapping[str, ReferenceSummary], *, simulated: bool
) -> QualitySection | None:
    """Look at every campaign in the order in which it was taken; None where all were imported."""
    taken = [item for item in campaigns if item.trials and item.recorded is None]
    if not taken and any(item.recorded is not None for item in campaigns):
        return None
    stream = "frames" if any(item.missing_stream == "events" for item in taken) else "events"
    return QualitySection(
        stream,
        [
            (name, WEAR[key][0], trend)
            for name, found in references.items()
            for key, trend in found.wear.items()
        ],
        [(item.name, campaign_figure(item, stream, simulated)) for item in taken],
        [(name, _references(name, found.trials, simulated)) for name, found in references.items()],
        [*_depth_zeros(taken), *(table for item in taken for table in _gates(item))],
    )


def campaign_figure(item: Collected, stream: str, simulated: bool) -> Figure:
    """Draw event rate, tightest gate and failed attempts over the plan."""
    numbers = [trial.index + 1 for trial, _ in item.trials]
    records = [recording.record for _, recording in item.trials]
    rates = [getattr(record.counts, stream) / record.recorded_s for record in records]
    nearest = [_nearest(record.quality.gates) for record in records]
    places = {trial.id: trial.index + 1 for trial in item.planned}
    failed = Counter(
        places[known["trial"]] for known in item.campaign.quarantined() if known["trial"] in places
    )
    again = dict(sorted(failed.items()))
    shares = [share for share, _ in nearest]
    svg = figures.over_campaign(numbers, rates, shares, again, stream=stream, simulated=simulated)
    data: dict[str, Sequence[object]] = {
        "trial": [trial.id for trial, _ in item.trials],
        "place in the plan": numbers,
        f"{stream} (1/s)": rates,
        "tightest gate": [name for _, name in nearest],
        "tightest gate (share of its limit)": shares,
        "failed attempts": [again.get(place, 0) for place in numbers],
    }
    return Figure(svg, name=f"quality-{item.name}", data=data)


def _nearest(gates: Mapping[str, Gate]) -> tuple[float, str]:
    """Return the largest share of its limit that any gate used, and which.

    A limit of 0 uses nothing.
    """
    shares = [
        (gate.value / gate.limit, name)
        for name, gate in gates.items()
        if gate.limit and gate.value is not None and not isinstance(gate.value, str)
    ]
    return max(shares, default=(0.0, ""))


def _in_units(gate: str, *values: float) -> list[str]:
    """Return a gate's name and figures as people read them: seconds in milliseconds."""
    if gate.endswith("_s"):
        gate, values = f"{gate.removesuffix('_s')}_ms", tuple(1e3 * value for value in values)
    return [gate, *(f"{value:,.0f}" if value >= 1e3 else f"{value:.3g}" for value in values)]


def _gates(item: Collected) -> list[Table]:
    """List the worst committed trial of every gate, and why attempts are in quarantine."""
    worst: dict[str, tuple[float, float, str]] = {}
    for trial, recording in item.trials:
        for name, gate in recording.record.quality.gates.items():
            value, limit = gate.value, gate.limit
            if value is None or isinstance(value, str) or limit is None:
                continue
            if name not in worst or value > worst[name][0]:
                worst[name] = (value, limit, trial.id)
    rows = [
        [*_in_units(name, limit, value), trial] for name, (value, limit, trial) in worst.items()
    ]
    caption = f"Campaign {item.name}: the committed trial that came nearest to each gate."
    found = [Table(("gate", "limit", "worst", "trial"), rows, caption)]
    causes = Counter(str(known["cause"]) for known in item.campaign.quarantined())
    if causes:
        listed = [[str(count), cause] for cause, count in causes.most_common()]
        found.append(Table(("attempts", "cause"), listed, f"Campaign {item.name}: quarantine."))
    return found


def _depth_zeros(taken: Sequence[Collected]) -> list[Table]:
    """List what touching off found in each campaign that does it; none if none does."""
    rows = []
    for item in taken:
        rezero = item.plan.protocol.collection.maintenance.rezero
        found = [
            (item.plan.rezero_task(trial).slot, record.depth_zero_mm, record.depth_zero_sd_mm)
            for trial, recording in item.trials
            for record in (recording.record,)
        ]
        # one slot is touched off for again after a pause
        blocks = [each for each, _ in groupby(found) if each[1] is not None]
        if rezero is None or not blocks:
            continue
        zeros = np.array([zero for _, zero, _ in blocks], np.float64)
        squares = [sd**2 for _, _, sd in blocks if sd is not None]
        sd = float(np.mean(squares)) ** 0.5 if squares else None
        rows.append(
            [
                item.name,
                str(len(blocks)),
                str(rezero.touches),
                *(f"{value:+.3f}" for value in (zeros[0], zeros[-1], zeros.min(), zeros.max())),
                *("-" if sd is None else f"{sd / share:.3f}" for share in (1, rezero.touches**0.5)),
            ]
        )
    columns = (
        "campaign",
        "touched off",
        "touches each",
        "first (mm)",
        "last (mm)",
        "lowest (mm)",
        "highest (mm)",
        "SD of one touch (mm)",
        "SD of their mean (mm)",
    )
    caption = (
        "Depth zero from the rig's plane, as touching off found it. A drift moves all depths; so "
        "does the scatter of single touches, which `touches` of `maintenance.rezero` averages."
    )
    return [Table(columns, rows, caption)] if rows else []


def references_of(store: TrialStore, campaigns: Sequence[Collected]) -> dict[str, ReferenceSummary]:
    """Return reference trials and wear by campaign, of those that take any."""
    found = {item.name: reference_trials(store, item) for item in campaigns}
    return {
        name: ReferenceSummary(trials=tuple(rows), wear=wear(rows))
        for name, rows in found.items()
        if rows
    }


def reference_trials(store: TrialStore, item: Collected) -> list[ReferenceTrial]:
    """Return the measurements of each committed reference trial, in the plan's order."""
    labels = Derived.of(store, LABELS, item.name)
    found = []
    for trial, recording in item.trials:
        if trial.role != "reference":
            continue
        known = labels.key(trial.id) is not None
        onset = labels.load(trial.id, TrialLabel).incipient_ns if known else None
        begin = recording.motion_ns[0]
        found.append(
            ReferenceTrial(
                trial=trial.id,
                place=trial.index + 1,
                hold_events_per_s=hold_rate(recording) if recording.record.counts.events else None,
                first_slip_ms=None if onset is None else (onset - begin) / 1e6,
            )
        )
    return found


def wear(rows: Sequence[ReferenceTrial]) -> dict[str, DriftTrend]:
    """Return the change of each figure over 100 trials, in percent of its median, with 95 %.

    The slope of Theil and Sen: one odd trial does not move it. None with fewer than three trials.
    """
    found = {}
    for name in _measured(rows):
        there = [(row.place, v) for row in rows if (v := getattr(row, name)) is not None]
        middle = float(np.median([value for _, value in there])) if there else 0.0
        slope: list[float | None] = [None, None, None]
        if len(there) >= FEWEST and middle:
            fit = theilslopes([value for _, value in there], [place for place, _ in there], 0.95)
            slope = [1e4 * float(value) / middle for value in (fit[0], fit[2], fit[3])]
        found[name] = DriftTrend(
            n=len(there), percent_per_100_trials=slope[0], low=slope[1], high=slope[2]
        )
    return found


def _measured(rows: Sequence[ReferenceTrial]) -> list[str]:
    """Return the figures that a rig measures: without events there is no rate of theirs."""
    events = any(row.hold_events_per_s is not None for row in rows)
    return [name for name in WEAR if events or name != "hold_events_per_s"]


def _references(name: str, rows: Sequence[ReferenceTrial], simulated: bool) -> Figure:
    places = [row.place for row in rows]
    measured = _measured(rows)
    panels = {WEAR[key][1]: [getattr(row, key) for row in rows] for key in measured}
    data: dict[str, Sequence[object]] = {
        "trial": [row.trial for row in rows],
        "place in the plan": places,
        "events in the hold (1/s)": [row.hold_events_per_s for row in rows],
        "motion to first slip (ms)": [row.first_slip_ms for row in rows],
    }
    svg = figures.references(places, panels, simulated=simulated)
    return Figure(svg, name=f"references-{name}", data=data)
