"""Clocks in the report: their uncertainty by trial, and its effect on latencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.figures.clocks import uncertainty_by_trial
from sliplab.analysis.report.page import Content, Figure, number
from sliplab.protocols.timing import WIRED
from sliplab.storage.schema.summary import LabelSummary, Sync
from sliplab.storage.schema.trial import DEVICES

PAGE = "sync.html"
"""File of the page about clocks, in the report's folder."""


def frames_grade(sync: Sync) -> str:
    """Return how frames are timed, for onsets are read from frames."""
    return sync.grade or "unknown clocks"


def frames_uncertainty(sync: Sync) -> str:
    """Return the worst trial's uncertainty of events against frames, as text."""
    worst = sync.worst_against_events_us
    return number(worst.get("frames", worst.get("arm")), 1, "µs")


def unwired(sync: Sync) -> bool:
    """Check if some trial's frames were timed through the host alone."""
    return any(grade not in WIRED for grade in frames_grade(sync).split(" or "))


def given_note(labels: LabelSummary) -> str:
    """Return how far onsets may be off that came with the recordings."""
    if labels.given_within_ms is None:
        return "onsets of the data set, whose uncertainty is unknown"
    return f"onsets of the data set, within {number(labels.given_within_ms, 1, 'ms')}"


def latency_note(sync: Sync, labels: LabelSummary | None = None) -> str:
    """Return the note under every table of latencies: the clocks' grade and uncertainty.

    Args:
        labels: names the onsets' origin where they came with the recordings.
    """
    if labels is not None and "given" in labels.error_ms.rule:
        return f"Latencies are against the {given_note(labels)}."
    if "events" not in sync.grades:
        return "Onsets and detections are both read from the frames: no clock lies between them."
    if "frames" not in sync.grades:
        return "Onsets and detections are both read from the events: no clock lies between them."
    note = (
        f"Frames: {frames_grade(sync)}; events against them within {frames_uncertainty(sync)}, "
        "worst trial."
    )
    if unwired(sync):
        note += (
            " No wire ties these frames to the events: every latency here may be off by that much."
        )
    return note


def figure_note(sync: Sync) -> str:
    """Return the same for a figure of latencies, where it can be seen in it; else nothing."""
    both = {"events", "frames"} <= sync.grades.keys()
    return f" {latency_note(sync)}" if unwired(sync) and both else ""


def short_note(sync: Sync, labels: LabelSummary | None = None) -> str:
    """Return the same for a headline latency."""
    if labels is not None and "given" in labels.error_ms.rule:
        return given_note(labels)
    if "frames" not in sync.grades:
        return "onsets by events"
    within = f", within {frames_uncertainty(sync)}" if unwired(sync) else ""
    return f"frames: {frames_grade(sync)}{within}"


def worst_clock(sync: Sync) -> tuple[str, str]:
    """Return the worst trial's uncertainty, and which device it is of, with its grade."""
    value = number(sync.worst_uncertainty_us, 1, "µs")
    known = sync.worst_against_events_us
    if not known:
        return value, "no clock"
    device = max(known, key=lambda name: known[name])
    against = "" if device == "events" else "events against "
    return value, f"{against}{device} ({sync.grades[device]})"


@dataclass(frozen=True)
class ClockSection(Content):
    """Uncertainty of every trial's clocks.

    Attributes:
        page: the file of the page about clocks, where there is one.
    """

    template: ClassVar[str] = "clocks.html"
    folded: ClassVar[bool] = True
    sync: Sync
    figure: Figure | None
    page: str | None


def clock_section(
    campaigns: Sequence[Collected], sync: Sync, *, page: bool, simulated: bool
) -> ClockSection | None:
    """Draw the clocks of all trials; None where all of them were imported, without sync pulses.

    Args:
        page: the page about clocks exists in the report's folder.
    """
    if all(item.recorded is not None for item in campaigns):
        return None
    figure = _figure(campaigns, sync, simulated) if sync.grades else None
    return ClockSection(sync, figure, PAGE if page else None)


def _figure(campaigns: Sequence[Collected], sync: Sync, simulated: bool) -> Figure:
    """Draw the uncertainty of each device in each trial."""
    starts: dict[str, int] = {}
    names: list[str] = []
    found: dict[str, list[float | None]] = {device: [] for device in DEVICES}
    for item in campaigns:
        if item.trials:
            starts[item.name] = len(names) + 1
        for trial, recording in item.trials:
            names.append(trial.id)
            for device in DEVICES:
                known = recording.clocks.against_events_ns(device)
                found[device].append(None if known is None else known / 1e3)
    drawn = {}
    for device, values in found.items():
        there = [(k, value) for k, value in enumerate(values, start=1) if value]
        if there:
            title = f"{device}, {sync.grades[device]}" if device in sync.grades else device
            drawn[title] = ([k for k, _ in there], [value for _, value in there])
    data = {f"{device}, uncertainty (µs)": values for device, values in found.items()}
    svg = uncertainty_by_trial(drawn, starts, simulated=simulated)
    return Figure(svg, name="clocks", data={"trial": names, **data})
