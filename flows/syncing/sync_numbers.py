"""A campaign's clocks in a few numbers: what the command prints and the page begins with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sliplab.flows.syncing.sync_trials import DeviceClocks, TrialClocks
from sliplab.storage.schema.trial import DEVICES

PULSES = ("missed", "late", "spurious")


def campaign_numbers(trials: Sequence[TrialClocks]) -> dict[str, Any]:
    """What is known of a campaign's clocks, by device; JSON."""
    devices = {}
    for name in DEVICES:
        there = [trial.devices[name] for trial in trials if name in trial.devices]
        if there:
            devices[name] = _device_numbers(there)
    return {
        "trials": len(trials),
        "changed": sum(trial.changed for trial in trials),
        "refused": sum(bool(trial.refused) for trial in trials),
        "devices": devices,
    }


def _device_numbers(there: Sequence[DeviceClocks]) -> dict[str, Any]:
    """One device in all trials that have it; uncertainties are of events against it."""
    uncertainty = [device.against_events_us for device in there]
    drift = [device.drift_ppm for device in there]
    wired = [device.pulses for device in there if device.pulses is not None]
    counts = {kind: sum(pulses[kind] for pulses in wired) for kind in PULSES}
    return {
        "grade": " or ".join(sorted({device.grade for device in there})),
        "kind": " or ".join(sorted({device.kind for device in there})),
        "trials": len(there),
        "uncertainty_us": {"median": float(np.median(uncertainty)), "worst": max(uncertainty)},
        "gates_us": sorted({device.gate_us for device in there if device.gate_us is not None}),
        "drift_ppm": [min(drift), max(drift)],
        "pulses": counts if wired else None,
    }
