"""The clock page, `report/sync.html`: the accuracy of every trial's time line.

A latency is a difference of two clocks. This page shows the residuals of their fits, so
that a device that drifts, misses pulses or has bad time stamps is visible over a whole campaign.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.clock_trials import (
    PULSES,
    DeviceClocks,
    TrialClocks,
    campaign_clocks,
    device_names,
)
from sliplab.analysis.report.figures.clocks import (
    GateLine,
    OverTrials,
    Residuals,
    over_trials,
    residuals,
)
from sliplab.analysis.report.page import Figure, Number, Table, number, render_page
from sliplab.storage.schema.trial import Gate, TrialRecord
from sliplab.storage.trials.checksums import RECORD
from sliplab.storage.trials.store import QuarantineEntry

WORST = 10
"""Number of worst trials that are shown."""


def render(
    campaigns: Sequence[Collected],
    trials: Mapping[str, Sequence[TrialClocks]],
    *,
    simulated: bool,
) -> str:
    """Render the page; everything in it is escaped but the figures' SVG.

    Args:
        trials: of every campaign, in the order in which they were taken.
    """
    shown = _Shown(trials, simulated)
    return render_page(
        "sync.html",
        simulated=simulated,
        campaigns=[item.name for item in campaigns],
        headline=_headline(shown),
        trials=len(shown.rows),
        by_campaign=_by_campaign(shown),
        unwired=[name for device, name in shown.titles.items() if not shown.wired(device)],
        residuals=_residuals(shown),
        drift=shown.draw(_drift(shown)),
        uncertainty=shown.draw([_uncertainty(shown)] if shown.rows else []),
        pulses=shown.draw(_pulses(shown)),
        most_uncertain=_most_uncertain(shown),
        most_missed=_most_missed(shown),
        doubtful=_doubtful(shown),
        quarantined=_quarantined(campaigns),
    )


class _Shown:
    """The trials of all campaigns, numbered from 1 to the last one."""

    def __init__(self, campaigns: Mapping[str, Sequence[TrialClocks]], simulated: bool) -> None:
        self.campaigns = {name: trials for name, trials in campaigns.items() if trials}
        trials = [trial for found in self.campaigns.values() for trial in found]
        self.rows = list(enumerate(trials, start=1))
        self.simulated = simulated

    @cached_property
    def devices(self) -> tuple[str, ...]:
        """Every device that is shown, first ones and further ones."""
        return device_names(trial for _, trial in self.rows)

    def of_device(self, name: str) -> list[tuple[int, DeviceClocks]]:
        """Return one device in all trials that have it."""
        return [
            (number, trial.devices[name]) for number, trial in self.rows if name in trial.devices
        ]

    def wired(self, name: str) -> bool:
        """Check if a device sees pulses in any trial."""
        return any(device.pulses is not None for _, device in self.of_device(name))

    @cached_property
    def titles(self) -> dict[str, str]:
        """Every device that some trial has, with its grades."""
        grades = {
            device: sorted({known.grade for _, known in self.of_device(device)})
            for device in self.devices
        }
        return {name: f"{name}, {' or '.join(found)}" for name, found in grades.items() if found}

    def series(
        self, device: str, value: Callable[[DeviceClocks], float | None]
    ) -> tuple[str, list[float], list[float]]:
        """Return a device's title, and numbers and values of the trials that have one."""
        found = [(number, value(known)) for number, known in self.of_device(device)]
        there = [(float(number), known) for number, known in found if known is not None]
        return self.titles[device], [number for number, _ in there], [known for _, known in there]

    def draw(self, panels: Sequence[OverTrials]) -> Figure | None:
        """Draw panels over the trials; None without a panel."""
        firsts, number = {}, 1
        for name, trials in self.campaigns.items():
            firsts[name] = float(number)
            number += len(trials)
        return Figure(over_trials(panels, firsts, simulated=self.simulated)) if panels else None


def _headline(shown: _Shown) -> list[Number]:
    changed = sum(trial.changed for _, trial in shown.rows)
    found = [Number("trials", str(len(shown.rows)), f"{changed} with refitted clocks in use")]
    for device, name in shown.titles.items():
        worst = max(known.against_events_us for _, known in shown.of_device(device))
        own = device == "events" or "events" not in shown.titles
        against = "own clock" if own else "events against it"
        found.append(Number(name, number(worst, 1, "µs"), f"worst trial, {against}"))
    return found


def _residuals(shown: _Shown) -> Figure | None:
    """Draw residuals of every device that has some."""
    panels = []
    for device, name in shown.titles.items():
        fitted = [
            trial
            for _, trial in shown.rows
            if device in trial.devices and f"{device}_us" in trial.residuals
        ]
        if not fitted:
            continue
        uncertainty = [trial.devices[device].against_events_us for trial in fitted]
        worst = fitted[uncertainty.index(max(uncertainty))]
        time_s, residual_us = (
            np.concatenate([trial.residuals[f"{device}_{unit}"] for trial in fitted])
            for unit in ("s", "us")
        )
        of_worst = (worst.residuals[f"{device}_s"], worst.residuals[f"{device}_us"])
        panels.append(Residuals(device, name, time_s, residual_us, *of_worst, worst.name))
    return Figure(residuals(panels, simulated=shown.simulated)) if panels else None


def _drift(shown: _Shown) -> list[OverTrials]:
    """Each device has its own scale, for crystals and ceramics differ much."""
    return [
        OverTrials(
            f"{device}\ndrift (ppm)",
            {device: shown.series(device, lambda known: known.drift_ppm)},
        )
        for device in shown.titles
    ]


def _uncertainty(shown: _Shown) -> OverTrials:
    """Uncertainty of events against the others by trial, with the gates."""
    others = [device for device in shown.titles if device != "events"]
    series = {
        device: shown.series(device, lambda known: known.against_events_us) for device in others
    }
    gates = [gate for device in others for gate in _gates(shown, device)]
    return OverTrials("uncertainty (µs)", series, gates, logarithmic=True)


def _gates(shown: _Shown, device: str) -> list[GateLine]:
    """Return a device's gates, one line as long as it stays the same."""
    gates: list[GateLine] = []
    for place, known in shown.of_device(device):
        if known.gate_us is None:
            continue
        last = gates[-1] if gates else None
        if last is not None and last.value == known.gate_us and last.last == place - 1:
            gates[-1] = GateLine(last.first, place, known.gate_us, device)
        else:
            gates.append(GateLine(place, place, known.gate_us, device))
    return gates


def _pulses(shown: _Shown) -> list[OverTrials]:
    """Missed and late pulses by trial, and lost frames."""
    panels = []
    for kind in ("missed", "late"):

        def count(known: DeviceClocks, kind: str = kind) -> float | None:
            return None if known.pulses is None else float(known.pulses[kind])

        series = {
            device: shown.series(device, count) for device in shown.titles if shown.wired(device)
        }
        if series:
            panels.append(OverTrials(f"{kind} pulses", series, whole=True))
    lost = [(n, trial.frames_lost) for n, trial in shown.rows if trial.frames_lost is not None]
    if lost:
        numbers, counts = ([float(value) for value in column] for column in zip(*lost, strict=True))
        series = {"frames": (shown.titles.get("frames", "frames"), numbers, counts)}
        panels.append(OverTrials("lost frames", series, whole=True))
    return panels


def _by_campaign(shown: _Shown) -> Table:
    """List one row a campaign and device."""
    rows = []
    for campaign, trials in shown.campaigns.items():
        known = campaign_clocks(trials)
        for name, device in known["devices"].items():
            uncertainty = device["uncertainty_us"]
            least, most = device["drift_ppm"]
            rows.append(
                [
                    campaign,
                    name,
                    device["grade"],
                    device["kind"],
                    number(uncertainty["median"]),
                    number(uncertainty["worst"]),
                    " or ".join(f"{gate:g}" for gate in device["gates_us"]) or "–",
                    f"{least:.2f} to {most:.2f}",
                    str(device["trials"]),
                    str(known["changed"]),
                ]
            )
    columns = (
        "campaign",
        "device",
        "grade",
        "uncertainty is",
        "median (µs)",
        "worst (µs)",
        "gate (µs)",
        "drift (ppm)",
        "trials",
        "refitted clocks in use",
    )
    return Table(columns, rows)


def _most_uncertain(shown: _Shown) -> Table:
    """List the trials with the highest uncertainty."""

    def against(trial: TrialClocks, name: str) -> str:
        known = trial.devices.get(name)
        return "–" if known is None else f"{number(known.against_events_us)} ({known.grade})"

    worst = sorted((trial for _, trial in shown.rows), key=lambda trial: -trial.worst_us)[:WORST]
    rows = [[*_named(trial), *(against(trial, name) for name in shown.devices)] for trial in worst]
    columns = ("trial", "campaign", "taken as no.", *(f"{name} (µs)" for name in shown.devices))
    return Table(columns, rows)


def _most_missed(shown: _Shown) -> Table:
    """List the trials in which most pulses were missed."""

    def counts(known: DeviceClocks | None) -> str:
        pulses = None if known is None else known.pulses
        return " / ".join(str(pulses[kind]) for kind in PULSES) if pulses else "–"

    hit = sorted((trial for _, trial in shown.rows if trial.missed), key=lambda t: -t.missed)
    rows = [
        [*_named(trial), *(counts(trial.devices.get(name)) for name in shown.devices)]
        for trial in hit[:WORST]
    ]
    return Table(("trial", "campaign", "taken as no.", *shown.devices), rows)


def _named(trial: TrialClocks) -> list[str]:
    return [trial.name, trial.campaign, str(trial.number)]


def _doubtful(shown: _Shown) -> Table:
    """List committed trials that would be rejected today."""
    rows = [[trial.name, trial.campaign, trial.doubt] for _, trial in shown.rows if trial.doubt]
    return Table(("trial", "campaign", "why"), rows)


def _quarantined(campaigns: Sequence[Collected]) -> Table:
    """List attempts that were quarantined because of a clock, with the reason as text."""
    rows = []
    for item in campaigns:
        for known in item.campaign.quarantined():
            reason = _reason(item.campaign.folder / "quarantine" / str(known["folder"]), known)
            if reason:
                attempt = known.get("attempt")
                shown = "–" if attempt is None else str(attempt)
                rows.append([str(known["trial"]), item.name, shown, reason])
    return Table(("trial", "campaign", "attempt", "cause"), rows)


def _reason(folder: Path, known: QuarantineEntry) -> str:
    """Return why, as far as clocks go; empty where it was something else."""
    if "gate: " not in str(known["cause"]) or not (folder / RECORD).exists():
        return ""
    gates = TrialRecord.load(folder / RECORD).quality.gates
    failed = {name: gate for name, gate in gates.items() if not gate.passed}
    found = [
        _uncertain(name.removeprefix("sync_uncertainty_").removesuffix("_s"), gate)
        for name, gate in failed.items()
        if name.startswith("sync_uncertainty_")
    ]
    return "; ".join(
        found
        + [_unvouched(gate) for name, gate in failed.items() if name.startswith("sync_unvouched_s")]
    )


def _uncertain(device: str, gate: Gate) -> str:
    if gate.value is None or isinstance(gate.value, str) or gate.limit is None:
        return f"{device} has no clock: {gate.value}"
    return (
        f"{device} ({gate.grade}): uncertain by {1e6 * gate.value:.1f} µs, "
        f"{1e6 * gate.limit:g} µs are allowed"
    )


def _unvouched(gate: Gate) -> str:
    if gate.value is None or isinstance(gate.value, str) or gate.value < 0:
        return "it is unknown which part of the recording the pulses cover"
    return (
        f"the recording continues for {gate.value:.2f} s beyond the pulses on which a clock "
        f"stands, {gate.limit:g} s are allowed"
    )
