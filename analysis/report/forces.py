"""Forces in the report: one trial's, its friction cone, and onsets by force and by label."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.force import has_forces, moving_mean, plate_forces
from sliplab.analysis.labels.label_errors import force_compared, spread
from sliplab.analysis.report.figures.forces import force_overview
from sliplab.analysis.report.page import Content, Figure, Table, number
from sliplab.analysis.windows.dataset import recorded_span
from sliplab.storage.schema.label import LABELS, TrialLabel
from sliplab.storage.trials.derived import Derived
from sliplab.storage.trials.recording import Recording
from sliplab.storage.trials.store import TrialStore

_MEAN = 10
"""Samples whose means are drawn."""
_FIGURES = (
    ("normal_hold_n", "normal force in the hold (N)"),
    ("normal_peak_n", "largest normal force (N)"),
    ("tangential_peak_n", "largest force along the plate (N)"),
    ("friction_peak", "largest ratio"),
)


@dataclass(frozen=True)
class ForceSection(Content):
    """Normal and tangential force, and the rule of the force compared with the others.

    Attributes:
        condition: of the trial that is drawn.
        friction: largest ratio of tangential to normal force in it.
        uncertainty_ms: of a moment of its forces against the events.
    """

    template: ClassVar[str] = "forces.html"
    folded: ClassVar[bool] = True
    condition: str
    friction: float
    uncertainty_ms: float
    trials: int
    figure: Figure
    figures: Table
    rules: Table


def force_section(
    store: TrialStore, campaigns: Sequence[Collected], shown: Recording | None, *, simulated: bool
) -> ForceSection | None:
    """Show the forces of the trials that have any; None where none has.

    Args:
        shown: the trial that the report shows, drawn here too where it has forces.
    """
    there = [
        (item, recording)
        for item in campaigns
        for _, recording in item.trials
        if recording.record.streams and has_forces(recording)
    ]
    if not there:
        return None
    slides = [recording for _, recording in there if recording.motion_phase == "slide"]
    drawn = shown if shown is not None and has_forces(shown) else (slides or [there[0][1]])[0]
    forces = plate_forces(drawn)
    start, end = recorded_span(drawn)
    forces = forces.between(start, end)
    label = _label(store, there, drawn)
    time_s = (forces.t_ns - start) / 1e9
    both = forces.normal_n, forces.tangential_n
    normal, along = (moving_mean(values, _MEAN) for values in both)
    friction = drawn.record.streams["force"].figures.get("friction_peak", float("nan"))
    onsets = [None, None] if label is None else [label.incipient_ns, label.gross_ns]
    by_force = label.force if label is not None else None
    knees = [None, None] if by_force is None else [by_force.incipient_ns, by_force.gross_ns]
    svg = force_overview(
        time_s,
        normal,
        along,
        friction,
        [None if t is None else (t - start) / 1e9 for t in onsets],
        [None if t is None else (t - start) / 1e9 for t in knees],
        simulated=simulated,
    )
    data = {
        "time since the recording began (s)": time_s.tolist(),
        "normal force (N)": normal.tolist(),
        "force along the plate (N)": along.tolist(),
    }
    return ForceSection(
        ", ".join(f"{name} {text}" for name, text in drawn.record.condition.items()),
        friction,
        forces.uncertainty_ns / 1e6,
        len(there),
        Figure(svg, name="forces", data=data),
        _figures(there),
        _rules(store, campaigns),
    )


def _label(
    store: TrialStore, there: Sequence[tuple[Collected, Recording]], drawn: Recording
) -> TrialLabel | None:
    for item, recording in there:
        labels = Derived.of(store, LABELS, item.name)
        same = recording.folder == drawn.folder
        if same and labels.key(recording.trial_id) is not None:
            return labels.load(recording.trial_id, TrialLabel)
    return None


def _figures(there: Sequence[tuple[Collected, Recording]]) -> Table:
    """List the figures of each campaign's trials: least, median, most."""
    rows = []
    for name in dict.fromkeys(item.name for item, _ in there):
        records = [r.record for item, r in there if item.name == name]
        for key, title in _FIGURES:
            values = sorted(
                record.streams["force"].figures[key]
                for record in records
                if key in record.streams["force"].figures
            )
            if values:
                found = (values[0], values[len(values) // 2], values[-1])
                rows.append([name, title, str(len(values)), *(number(v, 2) for v in found)])
    return Table(("campaign", "of each trial", "trials", "least", "median", "most"), rows)


def _rules(store: TrialStore, campaigns: Sequence[Collected]) -> Table:
    """List onsets by the force less those of the other rules, and less the truth where known."""
    columns = (
        "force less the",
        "onset",
        "trials",
        "median (ms)",
        "median distance (ms)",
        "largest (ms)",
    )
    rows = []
    for (title, onset), values in force_compared(store, campaigns).items():
        found = spread(values)
        cells = (found.median, found.median_abs, found.max_abs)
        rows.append([title, f"{onset} onset", str(found.n), *(number(v, 1) for v in cells)])
    return Table(columns, rows)
