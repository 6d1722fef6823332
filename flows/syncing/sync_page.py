"""The page about clocks, `report/sync.html`: how good every trial's time line is, and why.

A latency is a difference of two clocks. This page shows what is left over after fitting them, so
that a device that drifts, misses pulses or stamps badly is seen over a campaign, not in one trial.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.figures.clocks import over_trials, residuals
from sliplab.analysis.report.page import Figure, Number, Section, Table, number, render_page
from sliplab.flows.syncing import sync_tables
from sliplab.flows.syncing.sync_series import (
    All,
    device_names,
    drift_panels,
    firsts,
    pulse_panels,
    residual_panels,
    uncertainty_panel,
)
from sliplab.flows.syncing.sync_trials import TrialClocks

PAGE = "sync.html"


def render(
    campaigns: Sequence[Collected],
    trials: Mapping[str, Sequence[TrialClocks]],
    *,
    simulated: bool,
) -> str:
    """The page as text; everything in it is escaped but the figures' SVG.

    Args:
        trials: of every campaign, in the order in which they were taken.
    """
    shown = All(trials)
    sections = (
        [
            _in_short(shown),
            _residuals(shown, simulated),
            _drift(shown, simulated),
            _uncertainty(shown, simulated),
            _pulses(shown, simulated),
            _worst(shown),
        ]
        if shown.rows
        else [Section("No trial yet", ["These campaigns hold no committed trial."])]
    )
    sections.append(_refused(campaigns, shown))
    return render_page(
        "sync.html",
        sections,
        simulated=simulated,
        campaigns=[item.name for item in campaigns],
        headline=_headline(shown),
    )


def _headline(shown: All) -> list[Number]:
    changed = sum(trial.changed for _, trial in shown.rows)
    found = [Number("trials", str(len(shown.rows)), f"{changed} with refitted clocks in use")]
    for device, name in device_names(shown).items():
        worst = max(
            trial.devices[device].against_events_us
            for _, trial in shown.rows
            if device in trial.devices
        )
        against = "own clock" if device == "events" else "events against it"
        found.append(Number(name, number(worst, 1, "µs"), f"worst trial, {against}"))
    return found


def _in_short(shown: All) -> Section:
    return Section(
        "What the numbers are",
        [
            "All times are told on the sync box's clock. Uncertainty is how far a device's clock "
            "map may be off anywhere within the trial: 95 % where the device sees the box's "
            "pulses, and a hard bound, which is never passed, where it is known through the host "
            "alone. A latency is a difference of two clocks, so what is shown for frames and arm "
            "is of events against them, both maps together.",
            "A delay that all pulses of a device share (its wire, its input) cannot be seen in "
            "any of these numbers.",
        ],
        tables=[sync_tables.by_campaign(shown)],
    )


def _residuals(shown: All, simulated: bool) -> Section:
    panels = residual_panels(shown)
    unwired = [name for device, name in device_names(shown).items() if not shown.wired(device)]
    text = [
        f"{', '.join(unwired)}: no pulses reach it, so that it has no residuals."
    ] if unwired else []  # fmt: skip
    if not panels:
        return Section("Residuals over a trial", text)
    return Section(
        "Residuals over a trial",
        text,
        [
            Figure(
                residuals(panels, simulated=simulated),
                "Time of the box less the fitted time, of pulses (of exposures, where frames are "
                "timed by a wire). A good fit scatters about zero all along: a slope or a bend "
                "would be a clock that the map does not follow. The worst trial is the one with "
                "the highest uncertainty; of every trial at most 200 pulses are shown, evenly "
                "spread.",
            )
        ],
    )


def _drift(shown: All, simulated: bool) -> Section:
    return Section(
        "Drift over the campaign",
        [
            "What the box gains on a device. The drift of the box cannot be told from that of the "
            "device: when all devices move together it is most likely the box that moved, when one "
            "moves alone it is that one. Where frames are timed by their arrival, it is the "
            "host's clock that drifts.",
        ],
        [
            Figure(
                over_trials(drift_panels(shown), firsts(shown), simulated=simulated),
                "One mark a trial. A step shows a device that was switched off in between or "
                "whose clock was set, a slow slope one that warms up.",
            )
        ],
    )


def _uncertainty(shown: All, simulated: bool) -> Section:
    return Section(
        "Uncertainty of events against frames and arm",
        [],
        [
            Figure(
                over_trials([uncertainty_panel(shown)], firsts(shown), simulated=simulated),
                "One mark a trial; the dashed lines are the protocol's gates for these grades. A "
                "trial is committed below them; above stands only one whose clocks came out "
                "worse when they were fitted again.",
            )
        ],
    )


def _pulses(shown: All, simulated: bool) -> Section:
    panels = pulse_panels(shown)
    if not panels:
        return Section("Pulses and frames", ["No device sees pulses, and no frames were counted."])
    return Section(
        "Pulses and frames",
        [
            "A missed pulse was sent by the box and not seen by the device; a late one was seen so "
            "far off the line that it is left out of the fit. Neither moves a clock: the code says "
            "which pulses are there."
        ],
        [
            Figure(
                over_trials(panels, firsts(shown), simulated=simulated),
                "Counts by trial. Lost frames are told by the camera's own counter.",
            )
        ],
    )


def _worst(shown: All) -> Section:
    return Section(
        "The worst trials",
        tables=[sync_tables.most_uncertain(shown), sync_tables.most_missed(shown)],
    )


def _refused(campaigns: Sequence[Collected], shown: All) -> Section:
    tables: list[Table] = []
    quarantined = sync_tables.quarantined(campaigns)
    doubtful = sync_tables.doubtful(shown)
    text = []
    if quarantined.rows:
        tables.append(quarantined)
    else:
        text.append("No attempt stands in quarantine because of a clock.")
    if doubtful.rows:
        tables.append(doubtful)
    else:
        text.append("Fitted again, every committed trial passes its gates.")
    return Section("Set aside, or in doubt", text, tables=tables)
