"""The report's words on clocks, with the way to their own page."""

from __future__ import annotations

from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.figures import clocks as figures
from sliplab.analysis.report.page import Figure, Link, Section, number
from sliplab.flows.syncing.sync_page import PAGE
from sliplab.storage.schema.trial import DEVICES
from sliplab.storage.trials.store import Store


def section(
    store: Store, campaigns: list[Collected], summary: dict[str, Any], simulated: bool
) -> Section:
    """How sure every trial's clocks are."""
    sync = summary["sync"]
    rows = [
        f"{device} ({grade}): {number(sync['worst_against_events_us'][device], 1, 'µs')}"
        for device, grade in sync["grades"].items()
    ]
    text = [
        "Events, frames and arm keep time by clocks of their own; the sync box's pulses tie them "
        f"together. Uncertainty in the worst trial: {'; '.join(rows)}. Of events it is that of "
        "their own clock, of the others that of events against them."
    ]
    links = []
    if (store.folder / "report" / PAGE).exists():
        links.append(Link(PAGE, "Residuals, drift and pulses by trial"))
    else:
        text.append("`sliplab sync` shows residuals, drift and pulses by trial.")
    pictures = [_figure(campaigns, sync["grades"], simulated)] if rows else []
    return Section("Clocks", text, pictures, links=links)


def _figure(campaigns: list[Collected], grades: dict[str, str], simulated: bool) -> Figure:
    """The uncertainty of each device in each trial."""
    starts: dict[str, int] = {}
    names: list[str] = []
    found: dict[str, list[float | None]] = {device: [] for device in DEVICES}
    for item in campaigns:
        if item.trials:
            starts[item.name] = len(names) + 1
        for trial, recording in item.trials:
            names.append(trial.id)
            clocks = recording.clocks
            for device in DEVICES:
                known = clocks.against_events_ns(device)
                found[device].append(None if known is None else known / 1e3)
    drawn = {}
    for device, values in found.items():
        there = [(k, value) for k, value in enumerate(values, start=1) if value]
        if there:
            title = f"{device}, {grades[device]}" if device in grades else device
            drawn[title] = ([k for k, _ in there], [value for _, value in there])
    return Figure(
        figures.uncertainty_by_trial(drawn, starts, simulated=simulated),
        "Uncertainty of each trial's clocks: of events their own, of frames and arm that of events "
        "against them. It limits every latency; a jump would be a loose wire or lost pulses.",
        "clocks",
        {
            "trial": names,
            **{f"{device}, uncertainty (µs)": values for device, values in found.items()},
        },
    )
