"""The clocks of all trials as series for figures: in the order taken, device by device."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property

import numpy as np

from sliplab.analysis.report.figures.clocks import Gate, OverTrials, Residuals
from sliplab.flows.syncing.sync_trials import DeviceClocks, TrialClocks
from sliplab.storage.schema.trial import DEVICES


class All:
    """The trials of all campaigns, numbered from 1 to the last one."""

    def __init__(self, campaigns: Mapping[str, Sequence[TrialClocks]]) -> None:
        self.campaigns = {name: trials for name, trials in campaigns.items() if trials}

    @cached_property
    def rows(self) -> list[tuple[int, TrialClocks]]:
        """Every trial with its number."""
        trials = [trial for found in self.campaigns.values() for trial in found]
        return list(enumerate(trials, start=1))

    def of_device(self, name: str) -> list[tuple[int, DeviceClocks]]:
        """One device in all trials that have it."""
        return [
            (number, trial.devices[name]) for number, trial in self.rows if name in trial.devices
        ]

    def wired(self, name: str) -> bool:
        """Whether a device sees pulses in any trial."""
        return any(device.pulses is not None for _, device in self.of_device(name))


def firsts(shown: All) -> dict[str, float]:
    """The number of every campaign's first trial."""
    found, number = {}, 1
    for name, trials in shown.campaigns.items():
        found[name] = float(number)
        number += len(trials)
    return found


def device_names(shown: All) -> dict[str, str]:
    """Every device that some trial has, with its grades."""
    names = {}
    for device in DEVICES:
        grades = sorted({known.grade for _, known in shown.of_device(device)})
        if grades:
            names[device] = f"{device}, {' or '.join(grades)}"
    return names


def residual_panels(shown: All) -> list[Residuals]:
    """Residuals of every device that has some."""
    panels = []
    for device, name in device_names(shown).items():
        fitted = [
            trial for _, trial in shown.rows
            if device in trial.devices and f"{device}_us" in trial.residuals
        ]  # fmt: skip
        if not fitted:
            continue

        def uncertainty(trial: TrialClocks, device: str = device) -> float:
            return trial.devices[device].against_events_us

        worst = max(fitted, key=uncertainty)
        panels.append(
            Residuals(
                device,
                name,
                np.concatenate([trial.residuals[f"{device}_s"] for trial in fitted]),
                np.concatenate([trial.residuals[f"{device}_us"] for trial in fitted]),
                worst.residuals[f"{device}_s"],
                worst.residuals[f"{device}_us"],
                worst.name,
            )
        )
    return panels


Series = tuple[str, list[float], list[float]]


def _series(
    shown: All, device: str, name: str, value: Callable[[DeviceClocks], float | None]
) -> Series:
    found = [(number, value(known)) for number, known in shown.of_device(device)]
    there = [(float(number), known) for number, known in found if known is not None]
    return name, [number for number, _ in there], [known for _, known in there]


def drift_panels(shown: All) -> list[OverTrials]:
    """Drift by trial; each device has its own scale, for crystals and ceramics differ much."""
    return [
        OverTrials(
            f"{device}\ndrift (ppm)",
            {device: _series(shown, device, name, lambda known: known.drift_ppm)},
        )
        for device, name in device_names(shown).items()
    ]


def uncertainty_panel(shown: All) -> OverTrials:
    """Uncertainty of events against the others by trial, with the gates."""
    series, gates = {}, []
    for device, name in device_names(shown).items():
        if device == "events":
            continue
        series[device] = _series(shown, device, name, lambda known: known.against_events_us)
        gates += _gates(shown, device)
    return OverTrials("uncertainty (µs)", series, gates, logarithmic=True)


def _gates(shown: All, device: str) -> list[Gate]:
    """A device's gates, one line as long as it stays the same."""
    gates: list[Gate] = []
    for number, known in shown.of_device(device):
        if known.gate_us is None:
            continue
        last = gates[-1] if gates else None
        if last is not None and last.value == known.gate_us and last.last == number - 1:
            gates[-1] = Gate(last.first, number, known.gate_us, device)
        else:
            gates.append(Gate(number, number, known.gate_us, device))
    return gates


def pulse_panels(shown: All) -> list[OverTrials]:
    """Missed and late pulses by trial, and lost frames."""
    panels = []
    for kind in ("missed", "late"):
        series = {}
        for device, name in device_names(shown).items():
            if shown.wired(device):

                def count(known: DeviceClocks, kind: str = kind) -> float | None:
                    return None if known.pulses is None else float(known.pulses[kind])

                series[device] = _series(shown, device, name, count)
        if series:
            panels.append(OverTrials(f"{kind} pulses", series, whole=True))
    lost = [
        (float(number), float(trial.frames_lost))
        for number, trial in shown.rows
        if trial.frames_lost is not None
    ]
    if lost:
        name = device_names(shown).get("frames", "frames")
        counts = [count for _, count in lost]
        series = {"frames": (name, [number for number, _ in lost], counts)}
        panels.append(OverTrials("lost frames", series, whole=True))
    return panels
