"""The tables of the page about clocks: by campaign, the worst trials, and what was set aside."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from sliplab.analysis.campaigns import Collected
from sliplab.analysis.report.page import Table, number
from sliplab.flows.syncing.sync_numbers import PULSES, campaign_numbers
from sliplab.flows.syncing.sync_series import All
from sliplab.flows.syncing.sync_trials import TrialClocks
from sliplab.storage.schema.trial import DEVICES, Gate, TrialRecord
from sliplab.storage.trials.checksums import RECORD

ROWS = 10
"""So many of the worst trials are shown."""


def by_campaign(shown: All) -> Table:
    """One row a campaign and device."""
    rows = []
    for campaign, trials in shown.campaigns.items():
        known = campaign_numbers(trials)
        for name, device in known["devices"].items():
            least, most = device["drift_ppm"]
            rows.append(
                [
                    campaign,
                    name,
                    device["grade"],
                    device["kind"],
                    number(device["uncertainty_us"]["median"]),
                    number(device["uncertainty_us"]["worst"]),
                    " or ".join(f"{gate:g}" for gate in device["gates_us"]) or "–",
                    f"{least:.2f} to {most:.2f}",
                    str(device["trials"]),
                    str(known["changed"]),
                ]
            )
    return Table(
        (
            "campaign", "device", "grade", "uncertainty is", "median (µs)", "worst (µs)",
            "gate (µs)", "drift (ppm)", "trials", "refitted clocks in use",
        ),
        rows,
        "Uncertainty of events is that of their own clock; of frames and arm, that of events "
        "against them.",
    )  # fmt: skip


def _against(trial: TrialClocks, name: str) -> str:
    if name not in trial.devices:
        return "–"
    known = trial.devices[name]
    return f"{number(known.against_events_us)} ({known.grade})"


def most_uncertain(shown: All) -> Table:
    """The trials with the highest uncertainty."""
    worst = sorted((trial for _, trial in shown.rows), key=lambda trial: -trial.worst_us)[:ROWS]
    rows = [
        [
            trial.name,
            trial.campaign,
            str(trial.number),
            *(_against(trial, name) for name in DEVICES),
        ]
        for trial in worst
    ]
    columns = ("trial", "campaign", "taken as no.", *(f"{name} (µs)" for name in DEVICES))
    return Table(columns, rows, "Uncertainty with its grade, the highest first.")


def most_missed(shown: All) -> Table:
    """The trials in which most pulses were missed."""
    hit = sorted((trial for _, trial in shown.rows if trial.missed), key=lambda t: -t.missed)
    rows = [
        [trial.name, trial.campaign, str(trial.number), *_counts(trial)] for trial in hit[:ROWS]
    ]
    columns = ("trial", "campaign", "taken as no.", *DEVICES)
    words = "Pulses missed / late / spurious; most missed first."
    return Table(columns, rows, words if rows else "No device missed a pulse in any trial.")


def _counts(trial: TrialClocks) -> list[str]:
    found = []
    for name in DEVICES:
        pulses = trial.devices[name].pulses if name in trial.devices else None
        shown = [pulses[kind] for kind in PULSES] if pulses else []
        found.append(" / ".join(map(str, shown)) or "–")
    return found


def doubtful(shown: All) -> Table:
    """Committed trials that would not be kept today."""
    rows = [[trial.name, trial.campaign, trial.doubt] for _, trial in shown.rows if trial.doubt]
    return Table(("trial", "campaign", "why"), rows, "Committed trials; look at them by hand.")


def quarantined(campaigns: Sequence[Collected]) -> Table:
    """Attempts that were set aside because of a clock, with the reason in words."""
    rows = []
    for item in campaigns:
        for known in item.campaign.quarantined():
            reason = _reason(item.campaign.folder / "quarantine" / str(known["folder"]), known)
            if reason:
                attempt = known.get("attempt")
                shown = "–" if attempt is None else str(attempt)
                rows.append([str(known["trial"]), item.name, shown, reason])
    return Table(
        ("trial", "campaign", "attempt", "why it was set aside"),
        rows,
        "Attempts in quarantine because of a clock.",
    )


def _reason(folder: Path, known: dict[str, Any]) -> str:
    """Why, as far as clocks go; empty where it was something else."""
    if "gate: " not in str(known["cause"]) or not (folder / RECORD).exists():
        return ""
    gates = TrialRecord.load(folder / RECORD).quality.gates
    failed = {name: gate for name, gate in gates.items() if not gate.passed}
    return "; ".join(
        words(name, gate)
        for start, words in _WORDS.items()
        for name, gate in failed.items()
        if name.startswith(start)
    )


def _uncertainty(name: str, gate: Gate) -> str:
    device = name.removeprefix("sync_uncertainty_").removesuffix("_s")
    if gate.value is None or isinstance(gate.value, str) or gate.limit is None:
        return f"{device} has no clock: {gate.value}"
    return (
        f"{device} ({gate.grade}): uncertain by {1e6 * gate.value:.1f} µs, "
        f"{1e6 * gate.limit:g} µs are allowed"
    )


def _unvouched(name: str, gate: Gate) -> str:
    if gate.value is None or isinstance(gate.value, str) or gate.value < 0:
        return "nobody knows which part of the recording the pulses vouch for"
    return (
        f"the recording goes on for {gate.value:.2f} s beyond the pulses on which a clock "
        f"stands, {gate.limit:g} s are allowed"
    )


_WORDS: dict[str, Callable[[str, Gate], str]] = {
    "sync_uncertainty_": _uncertainty,
    "sync_unvouched_s": _unvouched,
}
